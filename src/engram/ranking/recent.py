"""The recent attempts W and their outcomes z, and this run's attempts (method §3.6, §4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import takewhile
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import PUBLIC, check_bounds


class IterationUnit(StrEnum):
    """Unit of one iteration of the localiser."""

    DISTANCE = "distance"
    FRAME = "frame"


@dataclass(frozen=True, slots=True)
class RecentConfig:
    """How far back the recent attempts reach.

    Raises:
        ConfigError: T is negative or the length is not positive.
    """

    T: Annotated[
        int,
        Meta(
            ge=0,
            description="iterations remembered; 5 to 200 are nearly alike. Source: [L15] Fig. 13",
        ),
        PUBLIC,
    ] = 10
    T_unit: Annotated[
        IterationUnit,
        Meta(
            description="distance makes one iteration of all frames within iteration_m of its "
            "first, so that the memory does not depend on the frame rate; frame makes one of each, "
            "as the paper does. Source: method §3.6"
        ),
        PUBLIC,
    ] = IterationUnit.DISTANCE
    iteration_m: Annotated[
        float, Meta(gt=0, description="length of an iteration, m. Source: method §3.6"), PUBLIC
    ] = 0.5

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """W and z of [L15 §V].

    Attributes:
        nodes: (W,) int32, dense indices of the nodes attempted, each once, least recent first.
        succeeded: (W,) bool, the latest outcome of each.
    """

    nodes: NDArray[np.int32]
    succeeded: NDArray[np.bool_]

    @staticmethod
    def none() -> Observations:
        """No attempts yet."""
        return Observations(np.zeros(0, np.int32), np.zeros(0, np.bool_))

    def __len__(self) -> int:
        return len(self.nodes)


# Attempts farther back do not reflect the light here.
_REMEMBERED_M = 200.0
# More than a usual drive makes on that way; a robot that stands makes them without end.
_REMEMBERED = 4096


@dataclass(frozen=True, slots=True, eq=False)
class RunAttempts:
    """Attempts of the live session over the last 200 m, oldest first.

    Attributes:
        driven_m: odometry distance of the live session now, metres.
        at_m: (R,) float64, that distance at each attempt.
        nodes: (R,) int32, dense indices of the attempted nodes.
        distance_m: (R,) float64, distance from the node to the measured position, or else root mean
            square of the predicted one, metres. NaN without a prediction (relocalisation).
        rates: (R,) float64, g at the predicted offset: probability of a match for compatible
            appearance. NaN without a prediction.
        accepted: (R,) bool, whether the match was accepted.
        inliers: (R,) int64, inliers of the match.
        landmarks: (R,) int64, landmarks of the live frame.
        frames: number of frames with attempts since the session began.
    """

    driven_m: float
    at_m: NDArray[np.float64]
    nodes: NDArray[np.int32]
    distance_m: NDArray[np.float64]
    rates: NDArray[np.float64]
    accepted: NDArray[np.bool_]
    inliers: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    frames: int = 0

    @staticmethod
    def none() -> RunAttempts:
        """No attempts yet."""
        nothing = np.zeros(0)
        return RunAttempts(
            0.0,
            nothing,
            np.zeros(0, np.int32),
            nothing,
            nothing,
            np.zeros(0, np.bool_),
            np.zeros(0, np.int64),
            np.zeros(0, np.int64),
        )

    def __len__(self) -> int:
        return len(self.nodes)

    def newest(self, count: int) -> RunAttempts:
        """The last `count` at most."""
        if len(self) <= count:
            return self
        last = slice(len(self) - count, None)
        return RunAttempts(
            self.driven_m,
            self.at_m[last],
            self.nodes[last],
            self.distance_m[last],
            self.rates[last],
            self.accepted[last],
            self.inliers[last],
            self.landmarks[last],
            self.frames,
        )


class AttemptHistory:
    """The attempts of one drive as it goes, from which policies learn.

    Call `begin_frame` before the attempts of a frame, and `add` after them. A failure without a
    prediction is not kept, as it says nothing of the appearance here: a lost robot has dozens per
    frame, all elsewhere.

    Its views: `observations`, over the last T iterations and the current one so far; and `run`,
    over the last 200 m, 4,096 attempts at most.
    """

    def __init__(self, config: RecentConfig | None = None) -> None:
        self.config = RecentConfig() if config is None else config
        # Node → twice the iteration of its latest attempt, plus its outcome; least recent first.
        self._latest: dict[int, int] = {}
        self._began_m: float | None = None
        self._number = -1
        self._driven_m = 0.0
        self._columns = _columns(64)
        self._start = self._end = 0
        self._frames = 0

    @property
    def iteration(self) -> int:
        """Number of the current iteration; one less than the first before the first frame."""
        return self._number

    def resume(self, next_iteration: int) -> None:
        """Continues with this iteration, without the last ones."""
        self._latest, self._began_m, self._number = {}, None, next_iteration - 1

    def begin_frame(self, driven_m: float) -> int:
        """Begins a frame at this distance driven, metres; returns its iteration."""
        self._driven_m = driven_m
        by_distance = self.config.T_unit is IterationUnit.DISTANCE
        if (
            by_distance
            and self._began_m is not None
            and driven_m - self._began_m < self.config.iteration_m
        ):
            return self._number
        self._began_m = driven_m
        self._number += 1
        oldest = 2 * (self._number - self.config.T)
        for node in list(takewhile(lambda node: self._latest[node] < oldest, self._latest)):
            del self._latest[node]
        return self._number

    def add(
        self,
        nodes: Sequence[int],
        foreseen: tuple[NDArray[np.float64], NDArray[np.float64]],
        accepted: Sequence[bool],
        inliers: Sequence[int],
        landmarks: int,
    ) -> None:
        """Adds the R attempts of the frame.

        See `RunAttempts` for the arguments; `foreseen` holds `distance_m` and `rates`, (R,) float64
        each.
        """
        self._frames += len(nodes) > 0
        distances_m, rates = (values.tolist() for values in foreseen)
        rows = zip(nodes, distances_m, rates, accepted, inliers, strict=True)
        kept = [row for row in rows if row[3] or not math.isnan(row[1])]
        if self._end + len(kept) > len(self._columns[0]):
            self._make_room(len(kept))
        for row in kept:
            self._latest.pop(row[0], None)
            self._latest[int(row[0])] = 2 * self._number + bool(row[3])
            for column, value in zip(self._columns, (self._driven_m, *row, landmarks), strict=True):
                column[self._end] = value
            self._end += 1

    @property
    def observations(self) -> Observations:
        """W and z now."""
        if self.config.T == 0:
            return Observations.none()
        count = len(self._latest)
        outcomes = np.fromiter(self._latest.values(), np.int64, count) & 1
        return Observations(
            np.fromiter(self._latest.keys(), np.int32, count), outcomes.astype(np.bool_)
        )

    def run(self) -> RunAttempts:
        """The attempts of the last 200 m. Its arrays are views of data that never changes."""
        self._forget()
        at_m, nodes, distance_m, rates, accepted, inliers, landmarks = (
            column[self._start : self._end] for column in self._columns
        )
        return RunAttempts(
            self._driven_m,
            at_m,
            nodes,
            distance_m,
            rates,
            accepted,
            inliers,
            landmarks,
            self._frames,
        )

    def _forget(self) -> None:
        at_m = self._columns[0][self._start : self._end]
        if len(at_m) and at_m[0] < self._driven_m - _REMEMBERED_M:
            self._start += int(np.searchsorted(at_m, self._driven_m - _REMEMBERED_M))
        self._start = max(self._start, self._end - _REMEMBERED)

    def _make_room(self, count: int) -> None:
        self._forget()
        kept = [column[self._start : self._end] for column in self._columns]
        self._start, self._end = 0, len(kept[0])
        self._columns = _columns(2 * (self._end + count))
        for column, values in zip(self._columns, kept, strict=True):
            column[: self._end] = values


def _columns(rows: int) -> list[NDArray[Any]]:
    """Empty columns in the order of `RunAttempts`."""
    kinds = (np.float64, np.int32, np.float64, np.float64, np.bool_, np.int64, np.int64)
    return [np.empty(rows, kind) for kind in kinds]
