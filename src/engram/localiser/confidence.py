"""How sure a match is: the log-odds that it is right, from all evidence when it is judged.

A street repeats: lamps, trees and kerb stones match one period off with twenty to thirty inliers,
consistently and with small covariances. So the number of inliers says little by itself. It counts
against what is usual for this camera, light and distance, and together with how well the robot's
position was known before: a position that fixes have confirmed again and again supports a weak
match, a hint that nothing has confirmed yet supports none.

The model is additive. A match has several readings: as what the position predicts, if fixes have
confirmed it; the same if the match is weak or later fixes are missing; as one near a position that
the caller supplied; and as that of a robot that may be anywhere. A calibration makes log-odds of
their sums that hold.
`CONFIDENCES` holds both for each kind of features, made and judged by ``python -m
engram_lab.fits.confidence``.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace

from engram.frontend.features import NET
from engram.frontend.frame import BRIEF, DescriptorKind
from engram.localiser.acceptance import Spread

# Number of fixes that show how many inliers are usual.
_USUAL_OF = 20
# Weight of the newest frame in the session's rate of success.
_NEWEST = 0.05
# Terms are bounded, so that no single one outweighs all others.
_MOST_AGREED = 20
_MOST_MISSED = 10.0
_LEAST_SIGMA_M, _MOST_SIGMA_M = 0.05, 30.0
_LEAST_RATIO, _MOST_RATIO = 0.03, 2.0
_MOST_APART = 2.0
_LEAST_TRACKED = 0.3
# A vaguer position does not excuse few inliers.
_SHARP_M = 0.5
_LEAST_SPREAD = 0.02


@dataclass(frozen=True, slots=True)
class Standing:
    """How far a robot's position can be relied on, before it looks.

    Attributes:
        agreed: number of fixes in a row that agreed with the position before them.
        missed: expected number of fixes since the last one, had the position been right: the sum
            of the session's rates of success.
        usual_inliers: median of the session's last fixes, none counted for more than its node has
            in common with its neighbour; 0 before the first.
        tracked: landmarks that odometry tracked to this frame, over the median at these fixes: what
            is left where drops on the lens, rain or dark hide the rest. 1 at most, or if unknown.
    """

    agreed: int = 0
    missed: float = 0.0
    usual_inliers: float = 0.0
    tracked: float = 1.0


UNKNOWN = Standing()


class Record:
    """Keeps the standing of a robot up to date, frame by frame."""

    def __init__(self) -> None:
        self._inliers: deque[int] = deque(maxlen=_USUAL_OF)
        self._tracked: deque[int] = deque(maxlen=_USUAL_OF)
        self._tracked_now = 0
        self._agreed = 0
        self._missed = 0.0
        self._rate = 0.5

    @property
    def standing(self) -> Standing:
        """The current one."""
        usual = _median(self._inliers)
        return Standing(self._agreed, self._missed, usual, self._share_tracked())

    def _share_tracked(self) -> float:
        usual = _median(self._tracked)
        now = self._tracked_now
        return min(now / usual, 1.0) if now and usual else 1.0

    def begin_frame(self, tracked: int) -> None:
        """Begins a frame to which odometry tracked so many landmarks; 0: unknown."""
        self._tracked_now = tracked

    def fixed(self, inliers: int, *, agrees: bool) -> None:
        """A match was accepted; `agrees` if the position had predicted it."""
        self._inliers.append(inliers)
        if self._tracked_now:
            self._tracked.append(self._tracked_now)
        self._agreed = self._agreed + 1 if agrees else 1
        self._missed = 0.0
        self._rate += _NEWEST * (1.0 - self._rate)

    def missed(self) -> None:
        """Attempts at the predicted position failed."""
        self._missed += self._rate
        self._rate -= _NEWEST * self._rate

    def settled(self) -> None:
        """The position is that of a node that was just saved."""
        self._missed = 0.0

    def forget(self, agreed: int = 0) -> None:
        """The position comes from elsewhere, where so many fixes have confirmed it."""
        self._agreed, self._missed = agreed, 0.0


def _median(numbers: Iterable[int]) -> float:
    """The median; 0 of none. That of `statistics` takes three times as long."""
    ordered = sorted(numbers)
    middle = len(ordered) // 2
    if not ordered or len(ordered) % 2:
        return float(ordered[middle]) if ordered else 0.0
    return (ordered[middle - 1] + ordered[middle]) / 2


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence about a match when it is judged.

    Attributes:
        share: of the landmarks of the poorer frame.
        match_sigma_m: root of the summed variances of the position.
        sigma_m: standard deviation of the predicted position; infinite without a prediction.
        apart: distance between measured and predicted position over `sigma_m` and a slack;
            infinite if they contradict each other, or without a prediction.
        spread: extent of the inliers; None beyond reach, and where fixes have confirmed the
            position and the match is not weak.
    """

    inliers: int
    share: float
    distance_m: float
    match_sigma_m: float
    standing: Standing = UNKNOWN
    sigma_m: float = math.inf
    apart: float = math.inf
    spread: Spread | None = None

    def match_terms(self) -> tuple[float, ...]:
        """Terms of the match itself; in every reading."""
        return (
            1.0,
            math.log(self.inliers / 20.0),
            math.log(max(self.share, 1e-3)),
            min(self.distance_m, 10.0),
            math.log(min(max(self.match_sigma_m, 0.01), 1.0)),
        )

    def expected_terms(self) -> tuple[float, ...]:
        """Terms of what was expected."""
        return (
            math.log1p(min(self.standing.missed, _MOST_MISSED)),
            math.log(min(max(self.sigma_m, _LEAST_SIGMA_M), _MOST_SIGMA_M)),
            min(self.apart, _MOST_APART),
        )

    def spread_terms(self) -> tuple[float, ...]:
        """Terms of how far the inliers spread."""
        spread = self.spread or Spread(0.0, 0.0, 0.0)
        height = min(spread.height, 1.0)
        return math.log(max(spread.image, _LEAST_SPREAD)), math.log(max(height, _LEAST_SPREAD))

    def predicted_terms(self) -> tuple[float, ...]:
        """Terms of the reading as what a position predicts that fixes have confirmed."""
        usual = self.standing.usual_inliers
        ratio = min(max(self.inliers / usual, _LEAST_RATIO), _MOST_RATIO) if usual else 1.0
        agreed = math.log1p(min(self.standing.agreed, _MOST_AGREED))
        sharp = self.sigma_m <= _SHARP_M
        tracked = math.log(max(self.standing.tracked, _LEAST_TRACKED)) if sharp else 0.0
        return *self.match_terms(), *self.expected_terms(), math.log(ratio), agreed, tracked

    def doubted_terms(self) -> tuple[float, ...]:
        """Terms of the same reading, with the spread, where position or match is weak."""
        return *self.predicted_terms(), *self.spread_terms()

    def told_terms(self) -> tuple[float, ...]:
        """Terms of the reading where a position that no fix has confirmed predicts the match."""
        return *self.match_terms(), *self.expected_terms(), *self.spread_terms()

    def anywhere_terms(self) -> tuple[float, ...]:
        """Terms of the reading as that of a robot that may be anywhere."""
        return *self.match_terms(), *self.spread_terms()


_MATCH_TERMS = ("constant", "inliers", "share", "distance", "match sigma")
_EXPECTED_TERMS = ("missed", "sigma", "apart")
_SPREAD_TERMS = ("spread", "height")
PREDICTED_TERMS = (*_MATCH_TERMS, *_EXPECTED_TERMS, "ratio", "agreed", "tracked")
DOUBTED_TERMS = (*PREDICTED_TERMS, *_SPREAD_TERMS)
TOLD_TERMS = (*_MATCH_TERMS, *_EXPECTED_TERMS, *_SPREAD_TERMS)
ANYWHERE_TERMS = (*_MATCH_TERMS, *_SPREAD_TERMS)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Log-odds that hold, from a sum of terms.

    What is wrong among the surest matches is seldom another place: it is the right one in rain, and
    a pose a metre off. No term predicts that, so among accepted matches the log-odds grow more
    slowly.

    Attributes:
        knee, slope: from this sum on, log-odds grow by so much of what it grows.
    """

    knee: float
    slope: float

    def log_odds(self, total: float) -> float:
        """Of a sum; -inf stays."""
        return total - (1.0 - self.slope) * max(total - self.knee, 0.0)


@dataclass(frozen=True, slots=True)
class ConfidenceModel:
    """Weights of the terms, one kind of features and one matcher.

    Attributes:
        predicted: of `Evidence.predicted_terms`.
        doubted: of `Evidence.doubted_terms`.
        told: of `Evidence.told_terms`.
        anywhere: of `Evidence.anywhere_terms`.
        witness: what a second match adds that agrees some distance later.
        weak_inliers: matches of fewer must spread even near a confirmed position: a robot that is
            carried elsewhere unseen meets look-alikes there, low in the image.
    """

    predicted: tuple[float, ...]
    doubted: tuple[float, ...]
    told: tuple[float, ...]
    anywhere: tuple[float, ...]
    witness: float
    weak_inliers: int
    calibration: Calibration

    def as_predicted(self, evidence: Evidence) -> float:
        """Log-odds of a match that agrees with its prediction; -inf if it does not.

        A position that no fix has confirmed speaks for a match only if its inliers spread.
        """
        if not math.isfinite(evidence.apart):
            return -math.inf
        if not evidence.standing.agreed:
            if evidence.spread is None:
                return -math.inf
            return self._log_odds(self.told, evidence.told_terms())
        if evidence.spread is None:
            return self._log_odds(self.predicted, evidence.predicted_terms())
        return self._log_odds(self.doubted, evidence.doubted_terms())

    def alone(self, evidence: Evidence) -> float:
        """Log-odds of a match as if no fix had come before it."""
        standing = evidence.standing
        unproved = replace(evidence, standing=Standing(0, standing.missed, standing.usual_inliers))
        if evidence.spread is None and math.isfinite(evidence.apart):
            return self._log_odds(self.predicted, unproved.predicted_terms())
        return max(self.as_predicted(unproved), self.as_anywhere(evidence))

    def as_anywhere(self, evidence: Evidence) -> float:
        """Log-odds of a match whatever was predicted; -inf if the spread is not known."""
        if evidence.spread is None:
            return -math.inf
        return self._log_odds(self.anywhere, evidence.anywhere_terms())

    def _log_odds(self, weights: tuple[float, ...], terms: tuple[float, ...]) -> float:
        return self.calibration.log_odds(sum(map(float.__mul__, weights, terms)))


# Source: python -m engram_lab.fits.confidence, method version 23: 0.66; one for both kinds, so that
# limits mean the same. `told` and `anywhere` are those of method version 10: a fit in today's towns
# leans on the match's own sigma, which is small in any room, and tells look-alikes no better.
_CALIBRATION = Calibration(knee=4.25, slope=0.65)
_BRIEF = ConfidenceModel(
    # constant, inliers, share, distance, match sigma, missed, sigma, apart, ratio, agreed, tracked
    predicted=(8.37, 0.0, 0.0, 0.0, 0.0, -3.036, -0.912, -1.568, 3.917, 0.0, -2.663),
    doubted=(  # the same terms, spread, height
        *(12.316, 0.0, 0.0, -0.338, 0.0, -1.507, -0.912, -1.64, 4.254, 0.0, -2.915),
        *(2.214, 1.436),
    ),
    # constant, inliers, share, distance, match sigma, missed, sigma, apart, spread, height
    told=(10.864, 0.257, 1.212, -0.124, -0.347, -0.003, -0.174, -2.589, 1.544, 0.77),
    # constant, inliers, share, distance, match sigma, spread, height
    anywhere=(13.904, 0.0, 3.055, -0.113, -0.512, 1.509, 0.777),
    witness=1.4,
    weak_inliers=45,
    calibration=_CALIBRATION,
)
# Source: the same with --kind net and the covariances of method version 11. The constants of
# `predicted` and `doubted` are 0.25, that of `told` 0.9 and that of `anywhere` 0.4 less than
# fitted, for as few look-alikes as of BRIEF.
_NET = ConfidenceModel(
    # the same terms
    predicted=(9.922, 0.0, 0.0, -0.317, -0.166, -2.705, -0.635, -1.254, 5.095, 0.0, -7.469),
    doubted=(
        *(14.217, 0.0, 0.0, -0.445, 0.0, -2.023, -0.545, -1.152, 5.565, 0.0, -6.712),
        *(2.611, 0.936),
    ),
    told=(4.568, 0.0, 0.792, -0.021, -2.498, 0.0, -0.194, -2.745, 0.839, 0.938),
    anywhere=(9.239, 0.0, 2.758, 0.0, -2.048, 0.933, 1.051),
    witness=1.4,
    weak_inliers=45,
    calibration=_CALIBRATION,
)
CONFIDENCES: dict[DescriptorKind, ConfidenceModel] = {BRIEF: _BRIEF, NET: _NET}


def confidence_of(kind: DescriptorKind) -> ConfidenceModel:
    """The weights for a kind of features; those of BRIEF for a kind without its own."""
    return CONFIDENCES.get(kind, _BRIEF)
