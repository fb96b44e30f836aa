"""Attempts to match a frame with candidates, and their record."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.errors import MapCorruptError
from engram.frontend.frame import Frame
from engram.frontend.matching import (
    NO_MATCH,
    Match,
    MatcherConfig,
    Question,
    arguments,
    features,
    match_frames,
    match_of,
    pair_seed,
)
from engram.geometry.se3 import SE3
from engram.graph.basin import MatchBasin
from engram.graph.model import Attempt, LandmarkSource, NodeId
from engram.graph.neighbourhood import Neighbourhood
from engram.localiser.acceptance import Lenses, Prediction, Spread, inlier_spread
from engram.localiser.confidence import UNKNOWN, Evidence, Standing
from engram.localiser.fixes import MatchRule
from engram.localiser.localisation import Position
from engram.localiser.settings import LocaliserConfig
from engram.ranking.recent import AttemptHistory


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A node to be attempted.

    Attributes:
        prediction: where the live camera is expected; None when relocalising.
        guided: whether matching uses the prediction (method §3.2).
        row: its row in the neighbourhood; None when relocalising.
        doubted: whether the prediction may be wrong: the robot is lost, and has no nodes of its
            own that confirm its position.
        standing: how far the robot's position can be relied on.
        lost_long: whether the robot has driven far without a match; see `lost_long_m`.
    """

    index: int
    node: NodeId
    prediction: Prediction | None
    guided: bool
    row: int | None
    doubted: bool = False
    standing: Standing = UNKNOWN
    lost_long: bool = False

    @property
    def guide(self) -> Prediction | None:
        """The prediction, if it guides the matching."""
        return self.prediction if self.guided else None


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """The outcome of one attempt.

    Attributes:
        rank: its place in the order, from 0.
        match: its match with the live frame.
        accepted: whether the match is a localisation.
        plausible: whether it would be one if another frame agreed.
        damaged: whether the node's landmarks are unreadable, which leaves nothing to match.
        evidence: what these were computed from; None without a pose.
    """

    candidate: Candidate
    rank: int
    match: Match
    accepted: bool
    plausible: bool = False
    damaged: bool = False
    confidence: float = -math.inf
    evidence: Evidence | None = None

    @property
    def position(self) -> Position:
        """The robot's position by this match, which must have a pose."""
        pose, covariance = self.match.reference_from_live, self.match.covariance
        assert pose is not None
        assert covariance is not None
        return Position(self.candidate.node, pose, covariance)


class Matcher(Protocol):
    """The first half of an attempt, a pure function of two frames (method §3.2)."""

    def match(self, live: Frame, live_id: NodeId, node: NodeId, guide: Prediction | None) -> Match:
        """The match of a live frame with a node; `guide` is given for a guided attempt only.

        Raises:
            MapCorruptError: the node's landmarks are damaged.
        """
        ...

    def matches(
        self, live: Frame, live_id: NodeId, candidates: Sequence[Candidate]
    ) -> list[Match | None]:
        """The matches with some candidates, None where a node is damaged; see `one_by_one`."""
        ...

    def spread(self, live: Frame, live_id: NodeId, node: NodeId, match: Match) -> Spread:
        """`inlier_spread` of such a match."""
        ...

    def prefetch(self, nodes: list[NodeId]) -> None:
        """Announces the nodes likely to be matched next. Returns at once."""
        ...


def one_by_one(
    matcher: Matcher, live: Frame, live_id: NodeId, candidates: Sequence[Candidate]
) -> list[Match | None]:
    """`Matcher.matches` by its `match`."""
    found: list[Match | None] = []
    for candidate in candidates:
        try:
            found.append(matcher.match(live, live_id, candidate.node, candidate.guide))
        except MapCorruptError:
            found.append(None)
    return found


class Lanes:
    """Matches with the landmarks that a source holds, several at once, on threads of the core.

    Matches are seeded by the UUIDs of both frames.

    Args:
        lost_config: settings where nothing is predicted; None for the same.
        count: number of lanes; the first is the thread of the caller.
    """

    def __init__(
        self,
        frames: LandmarkSource,
        config: MatcherConfig,
        lost_config: MatcherConfig | None = None,
        count: int = 1,
    ) -> None:
        self._frames = frames
        self._config = config
        self._lost_config = lost_config or config
        self._threads = _core.WorkThreads(count - 1)

    def match(self, live: Frame, live_id: NodeId, node: NodeId, guide: Prediction | None) -> Match:
        """See `Matcher`."""
        seed = pair_seed(live_id, node)
        return match_frames(self._frames.frame(node), live, self._config, seed, *_expected(guide))

    def matches(
        self, live: Frame, live_id: NodeId, candidates: Sequence[Candidate]
    ) -> list[Match | None]:
        """See `Matcher`."""
        questions = [self._question(live_id, candidate) for candidate in candidates]
        asked = [arguments(question, live) for question in questions if question is not None]
        found = iter(_core.attempt(features(live), asked, self._threads))
        return [None if question is None else match_of(next(found)) for question in questions]

    def spread(self, live: Frame, live_id: NodeId, node: NodeId, match: Match) -> Spread:
        """See `Matcher`."""
        del live_id
        return inlier_spread(match, self._frames.frame(node), live)

    def prefetch(self, nodes: list[NodeId]) -> None:
        """See `Matcher`."""
        self._frames.prefetch(nodes)

    def close(self) -> None:
        """Ends the threads; later matches are made on the caller's."""
        self._threads = _core.WorkThreads(0)

    def _question(self, live_id: NodeId, candidate: Candidate) -> Question | None:
        """What the live frame is matched with; None if the node is damaged."""
        config = self._lost_config if candidate.prediction is None else self._config
        try:
            reference = self._frames.frame(candidate.node)
        except MapCorruptError:
            return None
        seed = pair_seed(live_id, candidate.node)
        return Question(reference, config, seed, *_expected(candidate.guide))


class Attempter:
    """Makes attempts: matches the live frame with nodes, and judges the matches.

    Args:
        matcher: the first half, for studies that keep matches; None for the landmarks of `frames`.
        lanes: how many matches with `frames` are made at once.
    """

    def __init__(
        self,
        frames: LandmarkSource,
        config: LocaliserConfig,
        matcher: Matcher | None = None,
        lanes: int = 1,
    ) -> None:
        self._lanes = Lanes(frames, config.matcher, config.lost_matcher, lanes)
        self._matcher = self._lanes if matcher is None else matcher
        self._frames = frames
        self._rule = MatchRule(config.acceptance)

    def close(self) -> None:
        """Ends the threads of the lanes."""
        self._lanes.close()

    def prefetch(self, nodes: list[NodeId]) -> None:
        """Announces the nodes likely to be attempted next."""
        self._matcher.prefetch(nodes)

    def frame(self, node: NodeId) -> Frame | None:
        """The frame that was saved as a node; None if it is damaged."""
        try:
            return self._frames.frame(node)
        except MapCorruptError:
            return None

    def attempt(self, live: Frame, live_id: NodeId, rank: int, candidate: Candidate) -> Outcome:
        """The outcome of matching one candidate; see `attempts`."""
        return self.attempts(live, live_id, rank, [candidate])[0]

    def attempts(
        self, live: Frame, live_id: NodeId, rank: int, candidates: Sequence[Candidate]
    ) -> list[Outcome]:
        """The outcomes of matching some candidates, at once as far as there are lanes.

        A node with damaged landmarks is reported in its outcome instead of raising: a robot can
        do without one node of its map.

        Args:
            live: the live frame.
            live_id: its UUID; with the node's UUID it seeds the matcher.
            rank: place of the first candidate in the order.
        """
        matches = self._matcher.matches(live, live_id, candidates)
        return [
            self._judged(live, live_id, rank + at, candidate, match)
            for at, (candidate, match) in enumerate(zip(candidates, matches, strict=True))
        ]

    def _judged(
        self, live: Frame, live_id: NodeId, rank: int, candidate: Candidate, match: Match | None
    ) -> Outcome:
        if match is None:
            return Outcome(candidate, rank, NO_MATCH, accepted=False, damaged=True)
        if match.reference_from_live is None:
            return Outcome(candidate, rank, match, accepted=False)
        spread = partial(self._matcher.spread, live, live_id, candidate.node, match)
        verdict = self._rule.verdict(live, candidate, match, spread)
        return Outcome(
            candidate,
            rank,
            match,
            verdict.accepted,
            verdict.waits,
            confidence=verdict.confidence,
            evidence=verdict.evidence,
        )

    def with_rows(self, live: Frame, live_id: NodeId, outcome: Outcome) -> Match:
        """The match of an outcome, with the rows of its inliers: a kept one may be without."""
        match = outcome.match
        if len(match.live_rows) == match.inliers:
            return match
        (found,) = self._lanes.matches(live, live_id, [outcome.candidate])
        return found or match


def _expected(guide: Prediction | None) -> tuple[SE3 | None, NDArray[np.float64] | None]:
    """The pose that guides matching, and its (6, 6) covariance."""
    if guide is None:
        return None, None
    covariance = np.zeros((6, 6))
    covariance.flat[:21:7], covariance.flat[21::7] = guide.sigma_m**2, guide.sigma_yaw_rad**2
    return guide.node_from_live, covariance


def split_at_first_success(
    outcomes: Sequence[Outcome],
) -> tuple[list[Outcome], list[Outcome]]:
    """What one lane would have attempted, up to the first success in ranked order; and the rest."""
    first = next((at for at, one in enumerate(outcomes) if one.accepted), len(outcomes))
    return list(outcomes[: first + 1]), list(outcomes[first + 1 :])


def alternate(first: list[Candidate], second: list[Candidate]) -> list[Candidate]:
    """first[0], second[0], first[1], … and the rest of the longer one."""
    shorter = min(len(first), len(second))
    paired = [item for pair in zip(first, second, strict=False) for item in pair]
    return paired + first[shorter:] + second[shorter:]


def outcome_at(outcomes: Sequence[Outcome], node: NodeId | None) -> Outcome | None:
    """The accepted outcome of a node, as that of a result; None if there is none."""
    return next(
        (outcome for outcome in outcomes if outcome.accepted and outcome.candidate.node == node),
        None,
    )


def add_outcomes(
    history: AttemptHistory,
    live: Frame,
    near: Neighbourhood | None,
    outcomes: Sequence[Outcome],
    basin: MatchBasin,
    lenses: Lenses,
) -> None:
    """Adds the outcomes of one frame to the history of its drive.

    Args:
        live: the frame.
    """
    history.add(
        [outcome.candidate.index for outcome in outcomes],
        _foreseen(near, outcomes, basin, lenses),
        [outcome.accepted for outcome in outcomes],
        [outcome.match.inliers for outcome in outcomes],
        len(live.landmarks),
    )


def stored_attempts(
    iteration: int,
    near: Neighbourhood,
    reference: NodeId,
    outcomes: Sequence[Outcome],
    policy: str,
) -> list[Attempt]:
    """The attempts of one iteration that had a prediction, as a map stores them (method §3.5)."""
    return [
        Attempt(
            iteration=iteration,
            reference=reference,
            node=outcome.candidate.node,
            along_m=float(near.along_m[row]),
            across_m=float(near.across_m[row]),
            yaw_rad=float(near.yaw_rad[row]),
            sigma_m=float(near.sigma_m[row]),
            sigma_yaw_rad=float(near.sigma_yaw_rad[row]),
            accepted=outcome.accepted,
            inliers=outcome.match.inliers,
            rank=outcome.rank,
            policy=policy,
        )
        for outcome in outcomes
        if (row := outcome.candidate.row) is not None
    ]


def _foreseen(
    near: Neighbourhood | None, outcomes: Sequence[Outcome], basin: MatchBasin, lenses: Lenses
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(R,) distances, metres, and rates of success of attempts; NaN without a prediction."""
    distance_m, rates = np.full((2, len(outcomes)), np.nan)
    predicted = [outcome.candidate.row for outcome in outcomes]
    known = [at for at, row in enumerate(predicted) if row is not None]
    if near is None or not known:
        return distance_m, rates
    rows = [row for row in predicted if row is not None]
    seen = lenses.as_seen(near)
    distance_m[known] = np.hypot(seen.distance_m[rows], seen.sigma_m[rows])
    rates[known] = basin.success_rate(seen.along_m[rows], seen.across_m[rows])
    for at, row in zip(known, rows, strict=True):
        pose = outcomes[at].match.reference_from_live
        if outcomes[at].accepted and pose is not None:
            from_node_m = pose.translation
            if seen is not near:
                shift_m = lenses.shifts_m(near.nodes[[row]])
                from_node_m = from_node_m - np.array([0.0, 0.0, *shift_m])
            distance_m[at] = math.sqrt(from_node_m @ from_node_m)
    return distance_m, rates
