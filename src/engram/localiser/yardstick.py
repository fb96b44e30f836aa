"""What a match usually has, measured on mapped roads, and how far below it a match is.

A street of equal fronts matches a mapped one with a third of the inliers that the mapped one has
with itself, frame after frame. A robot that has only met such matches finds them usual, and a run
of them agrees. So the yardstick is the map's: what a node has in common with the node before it,
which the same drive saved a metre back in the same light.

Light, rain and years leave fewer inliers, too, but they take landmarks here and there, and change
descriptors. Copies of a front look alike to the bit, and what stands around them has no match:
landmarks are missing in whole places.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.frontend.frame import BRIEF, DescriptorKind, Frame, Landmarks
from engram.frontend.frontend import FrontendConfig, as_live
from engram.frontend.matching import Match, MatcherConfig, match_frames, pair_seed
from engram.graph.graph import ExperienceGraph
from engram.graph.model import EdgeKind, NodeId

# Log-odds of one match at most.
_MOST = 3.0
# A chain has a node each metre or so; a node farther away shows other things.
_NEIGHBOUR_M = 4.0
# Places are parts of the image's width, and of the distance up to the farthest in equal ratios.
_COLUMNS, _DEPTHS, _FARTHEST_M = 8, 8, 64.0
# Usual landmarks in view of a frame of 600.
_COUNTED = 175
# Nearer or farther than by this factor a landmark looks different.
_SAME_SIZE = 1.5
# Less says no more: of few landmarks chance makes it small. Nor does more: a front that was rebuilt
# and a van that hides half of the view leave holes as large as copies do.
_LEAST_UNEVENNESS, _MOST_UNEVENNESS = 0.5, 3.0


@dataclass(frozen=True, slots=True)
class LookalikeConfig:
    """How runs of matches are distinguished from runs of look-alikes.

    Source: `lab/reports/lookalikes.md`.
    """

    doubt: Annotated[
        float,
        Meta(
            ge=0,
            description="log-odds that a run is one of look-alikes, beyond which it is no longer "
            "accepted; 0: look-alikes are not detected",
        ),
    ] = 1.59
    doubt_first: Annotated[
        float, Meta(ge=0, description="the same of the first match of a run")
    ] = 1.34
    proof: Annotated[
        float,
        Meta(
            ge=0,
            description="log-odds that a run is not of look-alikes, from which a doubted one is "
            "accepted again",
        ),
    ] = 0.08
    edges: Annotated[
        float,
        Meta(
            ge=0,
            description="log-odds that a run is not of look-alikes, from which its matches create "
            "edges; until then these wait",
        ),
    ] = 4.0
    most: Annotated[
        float,
        Meta(
            gt=0,
            description="log-odds that a run is not of look-alikes, from which it is no "
            "longer judged while its matches are predicted; also the upper bound of a run",
        ),
    ] = 8.0
    apart_m: Annotated[
        float,
        Meta(gt=0, description="distance from which two matches of a run are independent, m"),
    ] = 6.0
    again_m: Annotated[
        float, Meta(ge=0, description="distance after which an accepted run is judged again, m")
    ] = 2.0
    forgotten_after_m: Annotated[
        float, Meta(gt=0, description="distance without a match after which a run begins again, m")
    ] = 30.0

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True, eq=False)
class Usual:
    """What a node has in common with its neighbour in the same drive.

    Attributes:
        bits: median number of bits in which descriptors of the inliers differ.
        rows: (inliers,) int32, rows of the node's landmarks that agree.
    """

    inliers: int
    bits: float
    rows: NDArray[np.int32]


class Yardstick:
    """Measures what matches with the nodes of a map usually have.

    Args:
        graph: the experience graph; it may grow.
        frame: the frame of a node; None if it is damaged.
        frontend: settings of the live robot's front-end: as such a live frame the neighbour is
            matched; None for the defaults.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        frame: Callable[[NodeId], Frame | None],
        config: MatcherConfig,
        frontend: FrontendConfig | None = None,
    ) -> None:
        self._graph = graph
        self._frame = frame
        self._config = config
        self._frontend = frontend
        self._known: dict[int, Usual | None] = {}

    def usual(self, index: int) -> Usual | None:
        """What the node with a dense index usually has; None if its drive saved no neighbour."""
        if index not in self._known:
            self._known[index] = self._measured(index)
        return self._known[index]

    def _measured(self, index: int) -> Usual | None:
        neighbour = self._neighbour(index)
        if neighbour is None:
            return None
        node = self._graph.node(index).id
        ours, theirs = self._frame(node), self._frame(neighbour)
        if ours is None or theirs is None:
            return None
        theirs = as_live(theirs, self._frontend)
        match = match_frames(ours, theirs, self._config, pair_seed(node, neighbour))
        if match.reference_from_live is None:
            return None
        return Usual(match.inliers, median_bits(match, ours, theirs), match.reference_rows)

    def _neighbour(self, index: int) -> NodeId | None:
        """The node before it in its drive; the next one if there is none.

        A node may be asked about at any time after it was saved: what follows it is then known or
        not, what precedes it always is.
        """
        node = self._graph.node(index)
        beside = [
            (self._graph.index(edge.b if edge.a == node.id else edge.a), edge)
            for edge in self._graph.edges_of(index, EdgeKind.ODOMETRY)
            if edge.a_from_b.distance_m <= _NEIGHBOUR_M
        ]
        behind = [one for one, edge in beside if edge.b == node.id]
        ahead = [one for one, edge in beside if edge.a == node.id]
        found = (behind or ahead)[-1:]
        return self._graph.node(found[0]).id if found else None


def median_bits(match: Match, reference: Frame, live: Frame) -> float:
    """Median number of bits in which descriptors of a match's inliers differ."""
    ours = reference.landmarks.descriptors[match.reference_rows]
    theirs = live.landmarks.descriptors[match.live_rows]
    return float(np.median(np.unpackbits(ours ^ theirs, axis=1).sum(axis=1)))


def unevenness(landmarks: Landmarks, usual: NDArray[np.int32], found: NDArray[np.int32]) -> float:
    """How far what a match found of the usual landmarks depends on the place.

    Places are columns of the image at one distance. The likelihood ratio of a rate each against one
    rate for all (the G statistic), over its degrees of freedom: about 1 where chance alone decides.
    What is beyond chance grows with the number of landmarks, and counts as of `_COUNTED` of them.

    Args:
        landmarks: those of the node.
        usual: (U,) int32, rows that usually match.
        found: (F,) int32, rows that match.
    """
    u, depth_m = landmarks.pixels[usual, 0], landmarks.points_in_cam[usual, 2]
    width = float(landmarks.pixels[:, 0].max(initial=0.0)) + 1.0
    column = (u * _COLUMNS / width).astype(np.int64)
    distance = np.log(np.maximum(depth_m, 1.0)) * _DEPTHS / math.log(_FARTHEST_M)
    place = np.clip(distance.astype(np.int64), 0, _DEPTHS - 1) * _COLUMNS + column
    hits = np.isin(usual, found)
    there = np.bincount(place, minlength=_COLUMNS * _DEPTHS)
    hit = np.bincount(place, weights=hits, minlength=_COLUMNS * _DEPTHS)[there > 0]
    there = there[there > 0]
    rate = float(np.clip(hits.mean(), 0.02, 0.98)) if len(hits) else 0.5
    rates = np.clip(hit / there, 1e-9, 1 - 1e-9)
    gained = hit * np.log(rates / rate) + (there - hit) * np.log((1 - rates) / (1 - rate))
    beyond_chance = float(2 * gained.sum() / max(len(there) - 1, 1)) - 1
    return 1 + beyond_chance * min(_COUNTED / max(len(usual), 1), 1.0)


def _in_view(match: Match, reference: Frame, live: Frame, usual: Usual) -> NDArray[np.int32]:
    """Rows of the usual landmarks that a match has in the live image, about as large as there."""
    assert match.reference_from_live is not None
    live_from_reference = match.reference_from_live.inverse()
    there = reference.landmarks.points_in_cam[usual.rows].astype(np.float64)
    points, camera = live_from_reference @ there, live.camera
    scale = there[:, 2] / np.maximum(points[:, 2], 0.1)
    u = camera.fx * points[:, 0] / np.maximum(points[:, 2], 0.1) + camera.cx
    v = camera.fy * points[:, 1] / np.maximum(points[:, 2], 0.1) + camera.cy
    seen = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return usual.rows[seen & (scale < _SAME_SIZE) & (scale > 1 / _SAME_SIZE)]


@dataclass(frozen=True, slots=True)
class Weights:
    """Log-odds that a match is a look-alike: a constant, and weights of `Likeness.terms`.

    Attributes:
        share: of ln(inliers / usual inliers).
        more_bits: of each bit.
        unevenness: of ln(unevenness).
    """

    constant: float
    share: float
    more_bits: float
    unevenness: float


# Source: `lab/reports/lookalikes.md`; its cost: python -m engram_lab.fits.lookalikes.
ALIKE = Weights(-6.25, -4.5, -0.1, 3.8)


@dataclass(frozen=True, slots=True)
class Likeness:
    """Evidence of a match for or against being a look-alike.

    Attributes:
        share: natural logarithm of its inliers over the usual ones.
        more_bits: how many bits more than usual its inliers differ in.
        unevenness: see `unevenness`.
    """

    share: float
    more_bits: float
    unevenness: float

    @staticmethod
    def of(match: Match, reference: Frame, live: Frame, usual: Usual) -> Likeness:
        """That of a match with a node; usual is what usually matches of what is in view."""
        rows = _in_view(match, reference, live, usual)
        return Likeness(
            math.log(match.inliers / max(len(rows), 1)),
            median_bits(match, reference, live) - usual.bits,
            unevenness(reference.landmarks, rows, match.reference_rows),
        )

    def terms(self) -> tuple[float, float, float]:
        """What is weighed; see `Weights`."""
        uneven = min(max(self.unevenness, _LEAST_UNEVENNESS), _MOST_UNEVENNESS)
        return self.share, self.more_bits, math.log(uneven)

    def alike(self, weights: Weights = ALIKE) -> float:
        """Log-odds that it is a look-alike."""
        share, bits, uneven = self.terms()
        alike = weights.constant + weights.share * share + weights.more_bits * bits
        return min(max(alike + weights.unevenness * uneven, -_MOST), _MOST)


class Run:
    """The log-odds that a run of matches is one of look-alikes.

    Once a run has shown enough it stays believed: while odometry and the map agree, a robot cannot
    have come to another street, even where fronts were rebuilt.

    Attributes:
        believed: whether its matches are accepted.
        proved: whether they showed enough of what matches usually have for edges: a wrong one
            folds the map permanently.
    """

    def __init__(self, config: LookalikeConfig) -> None:
        self._config = config
        self._alike = 0.0
        self._at_m: float | None = None
        self.believed = self.proved = True
        self._new = True

    def begin(self) -> None:
        """The next match is of another run."""
        self._alike, self._at_m, self.believed, self.proved = 0.0, None, True, True
        self._new = True

    def measured(self) -> None:
        """The position was measured from nodes of the map before: a new run has proved itself."""
        if self._new:
            self._alike, self._new = -self._config.edges, False

    def due(self, driven_m: float) -> bool:
        """Whether a match after so many metres says more than those before."""
        if self._at_m is None:
            return True
        since_m = driven_m - self._at_m
        if since_m > self._config.forgotten_after_m:
            self.begin()
            return True
        if self._alike <= -self._config.most:
            self._at_m = driven_m
            return False
        return not self.believed or since_m >= self._config.again_m

    def add(self, alike: float, driven_m: float) -> None:
        """Adds a match, by its log-odds of being a look-alike, after so many metres."""
        config, first = self._config, self._new
        step_m = config.apart_m if self._at_m is None else driven_m - self._at_m
        total = self._alike + min(step_m / config.apart_m, 1.0) * alike
        self._alike = min(max(total, -config.most), config.most)
        self._at_m, self._new = driven_m, False
        if self.believed:
            self.believed = self._alike <= (config.doubt_first if first else config.doubt)
        else:
            self.believed = self._alike <= -config.proof
        shown = self._alike <= -config.edges or (self.proved and not first)
        self.proved = self.believed and shown


def is_measured(kind: DescriptorKind) -> bool:
    """Whether the yardstick is known for a kind of features."""
    return kind == BRIEF
