"""What a match usually has, measured on mapped roads, and how far below it a match is.

A street of equal fronts matches a mapped one with a third of the inliers that the mapped one has
with itself, frame after frame. A robot that has only met such matches finds them usual, and a run
of them agrees. So the yardstick is the map's: what a node has in common with the node before it,
which the same drive saved a metre back in the same light.

Light, rain and years leave fewer inliers, too, but they change descriptors: the inliers themselves
differ in more bits. Copies of a front look alike to the bit, and what stands around them has no
match. And where landmarks of node and live frame lie in one direction at different depths, one of
the two sees through something that should be there.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.frontend.frame import BRIEF, DescriptorKind, Frame
from engram.frontend.matching import Match, MatcherConfig, match_frames, pair_seed
from engram.graph.graph import ExperienceGraph
from engram.graph.model import EdgeKind, NodeId

# ln(inliers / usual inliers) of right matches, by how many bits more than usual they differ in.
# Source: `hamlet` in all pairs of its dry drives.
_MORE_BITS = (0.0, 7.0, 12.0, 17.0, 22.0, 27.0, 32.0, 42.0)
_RIGHT = (-0.42, -0.52, -0.61, -0.90, -1.21, -1.35, -1.46, -1.66)
# From so many more bits on, and from so few tracked landmarks down, less and less is judged.
_JUDGED_BITS, _NOT_JUDGED_BITS = 13.9, 20.4
_JUDGED_TRACKED, _NOT_JUDGED_TRACKED = 0.8, 0.6
# Log-odds of a look-alike by what is missing of that logarithm, and by contradicted landmarks, each
# beyond what right matches often have; of one match at most. Source: rings between equal fronts of
# 20, 30 and 37.5 m against the same drives.
_OF_SHARE, _OFTEN_MISSING = 2.93, 0.37
_OF_DEPTHS, _OFTEN_CONTRADICTED = 7.0, 0.11
_MOST = 3.0
# What a run had before is forgotten by this share over `apart_m` that nothing can be judged.
_FORGOTTEN = 0.3
# A chain has a node each metre or so; a node farther away shows other things.
_NEIGHBOUR_M = 4.0
# Landmarks within this many pixels lie in one direction; those nearer than this have a depth.
_DIRECTION_PX = 4
_NEAR_M = 25.0
_LEAST_DEPTH_M = 1.5
# Directions that count as agreeing without being seen, so that few of them say little.
_UNSEEN = 20.0
# Newest matches that tell how the light has changed since a map was made.
_LIGHT_OF = 40


@dataclass(frozen=True, slots=True)
class LookalikeConfig:
    """How runs of matches are distinguished from runs of look-alikes.

    Source: ``python -m engram_lab.checks.equal_fronts``.
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
            "accepted again, and edges are created",
        ),
    ] = 0.08
    most: Annotated[
        float, Meta(gt=0, description="greatest absolute log-odds of a run: it may change")
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


@dataclass(frozen=True, slots=True)
class Usual:
    """What a node has in common with its neighbour in the same drive.

    Attributes:
        bits: median number of bits in which descriptors of the inliers differ.
    """

    inliers: int
    bits: float


class Yardstick:
    """Measures what matches with the nodes of a map usually have.

    Args:
        graph: the experience graph; it may grow.
        frame: the frame of a node; None if it is damaged.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        frame: Callable[[NodeId], Frame | None],
        config: MatcherConfig,
    ) -> None:
        self._graph = graph
        self._frame = frame
        self._config = config
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
        match = match_frames(ours, theirs, self._config, pair_seed(node, neighbour))
        if match.reference_from_live is None:
            return None
        return Usual(match.inliers, median_bits(match, ours, theirs))

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


def contradicted(match: Match, reference: Frame, live: Frame) -> float:
    """Share of the near landmarks without a match that lie behind or before another one's.

    A landmark of the node is seen in the live camera as the match says. Where a live landmark lies
    in the same direction, but at another depth, something has come or gone.

    Args:
        reference: the node's frame.
        live: the live frame.
    """
    assert match.reference_from_live is not None
    camera = live.camera
    live_rows = np.ones(len(live.landmarks), np.bool_)
    live_rows[match.live_rows] = False
    rows = np.ones(len(reference.landmarks), np.bool_)
    rows[match.reference_rows] = False
    points = match.reference_from_live.inverse() @ reference.landmarks.points_in_cam[rows].astype(
        np.float64
    )
    points = points[points[:, 2] > _LEAST_DEPTH_M]
    u = camera.fx * points[:, 0] / points[:, 2] + camera.cx
    v = camera.fy * points[:, 1] / points[:, 2] + camera.cy
    seen = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    expected_px = camera.focal_baseline / points[seen, 2]
    found_px = _disparity_at(
        np.column_stack([u[seen], v[seen]]),
        live.landmarks.pixels[live_rows],
        live.landmarks.disparity_px[live_rows],
        (camera.width, camera.height),
    )
    greater_px = np.fmax(expected_px, found_px)
    counts = greater_px > camera.focal_baseline / _NEAR_M  # not where there is none: NaN
    apart = np.abs(expected_px - found_px) > 1.0 + 0.1 * greater_px
    counts &= np.isfinite(found_px)
    return float((apart & counts).sum() + _OFTEN_CONTRADICTED * _UNSEEN) / float(
        counts.sum() + _UNSEEN
    )


def _disparity_at(
    pixels: NDArray[np.floating],
    landmarks: NDArray[np.floating],
    disparity_px: NDArray[np.floating],
    size: tuple[int, int],
) -> NDArray[np.float64]:
    """(N,) disparity of a landmark near each of (N, 2) pixels, NaN where there is none."""
    width, height = (extent // _DIRECTION_PX + 3 for extent in size)
    raster = np.full((height, width), np.nan)
    column, row = (landmarks // _DIRECTION_PX).astype(np.int64).T + 1
    raster[row, column] = disparity_px
    column, row = (pixels // _DIRECTION_PX).astype(np.int64).T + 1
    near = np.stack([raster[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    near = near[[4, 1, 3, 5, 7, 0, 2, 6, 8]]  # its own cell first, then those beside it
    first = np.isfinite(near).argmax(axis=0)
    found: NDArray[np.float64] = near[first, np.arange(near.shape[1])]
    return found


@dataclass(frozen=True, slots=True)
class Likeness:
    """Evidence of a match for or against being a look-alike.

    Attributes:
        share: natural logarithm of its inliers over the usual ones.
        more_bits: how many bits more than usual its inliers differ in.
        contradicted: see `contradicted`.
        tracked: landmarks that odometry tracked over the usual inliers, 1 at most or if unknown.
    """

    share: float
    more_bits: float
    contradicted: float
    tracked: float = 1.0

    @staticmethod
    def of(match: Match, reference: Frame, live: Frame, usual: Usual, tracked: int) -> Likeness:
        """That of a match, in whose live frame odometry tracked so many landmarks; 0: unknown."""
        return Likeness(
            math.log(match.inliers / max(usual.inliers, 1)),
            median_bits(match, reference, live) - usual.bits,
            contradicted(match, reference, live),
            min(tracked / max(usual.inliers, 1), 1.0) if tracked else 1.0,
        )

    def judged(self) -> float:
        """How far it can be judged in its light, 0 to 1."""
        light = (_NOT_JUDGED_BITS - self.more_bits) / (_NOT_JUDGED_BITS - _JUDGED_BITS)
        seen = (self.tracked - _NOT_JUDGED_TRACKED) / (_JUDGED_TRACKED - _NOT_JUDGED_TRACKED)
        return min(max(light, 0.0), 1.0) * min(max(seen, 0.0), 1.0)

    def alike(self) -> float:
        """Log-odds that it is a look-alike, if it can be judged."""
        missing = float(np.interp(self.more_bits, _MORE_BITS, _RIGHT)) - self.share
        alike = _OF_SHARE * (missing - _OFTEN_MISSING)
        alike += _OF_DEPTHS * (self.contradicted - _OFTEN_CONTRADICTED)
        return min(max(alike, -_MOST), _MOST)


class Run:
    """The log-odds that a run of matches is one of look-alikes.

    Attributes:
        believed: whether its matches are accepted.
        proved: whether they showed, on the whole, what matches usually have.
    """

    def __init__(self, config: LookalikeConfig) -> None:
        self._config = config
        self._more_bits: deque[float] = deque(maxlen=_LIGHT_OF)
        self._tracked: deque[float] = deque(maxlen=_LIGHT_OF)
        self._alike = 0.0
        self._at_m: float | None = None
        self.believed = self.proved = True

    def begin(self) -> None:
        """The next match is of another run."""
        self._alike, self._at_m, self.believed, self.proved = 0.0, None, True, True

    def due(self, driven_m: float) -> bool:
        """Whether a match after so many metres says more than those before."""
        if self._at_m is None:
            return True
        since_m = driven_m - self._at_m
        if since_m > self._config.forgotten_after_m:
            self.begin()
            return True
        return not self.believed or since_m >= self._config.again_m

    def add(self, found: Likeness, driven_m: float) -> None:
        """Adds what a match shows after so many metres."""
        config, first = self._config, self._at_m is None
        self._more_bits.append(found.more_bits)
        self._tracked.append(found.tracked)
        found = replace(
            found,
            more_bits=float(np.median(self._more_bits)),
            tracked=float(np.median(self._tracked)),
        )
        step_m = config.apart_m if self._at_m is None else driven_m - self._at_m
        weight, judged = min(step_m / config.apart_m, 1.0), found.judged()
        total = self._alike + judged * weight * found.alike()
        total *= 1.0 - _FORGOTTEN * (1.0 - judged) * weight
        self._alike = min(max(total, -config.most), config.most)
        self._at_m = driven_m
        if self.believed:
            self.believed = self._alike <= (config.doubt_first if first else config.doubt)
        else:
            self.believed = self._alike <= -config.proof * judged
        usual = self._alike <= -config.proof * judged
        self.proved = self.believed and (usual or (self.proved and not first))


def is_measured(kind: DescriptorKind) -> bool:
    """Whether the yardstick is known for a kind of features."""
    return kind == BRIEF
