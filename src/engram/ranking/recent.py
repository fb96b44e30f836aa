"""The recent attempts W and their outcomes z, and this run's attempts (method §3.6, §4)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
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
    """Settings of `RecentAttempts`.

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


class RecentAttempts:
    """The window over the last T iterations, fed by the localiser.

    Call `begin_frame` before the attempts of a frame, and `add` after them; W is `observations`.
    Frames see the T iterations before the current one, and its attempts so far.
    """

    def __init__(self, config: RecentConfig | None = None, first_iteration: int = 0) -> None:
        self._config = RecentConfig() if config is None else config
        # Node → twice the iteration of its latest attempt, plus its outcome; least recent first.
        self._latest: dict[int, int] = {}
        self._began_m: float | None = None
        self._number = first_iteration - 1

    @property
    def iteration(self) -> int:
        """Number of the current iteration; one less than the first before the first frame."""
        return self._number

    def begin_frame(self, driven_m: float) -> int:
        """Begin a frame at this distance driven, metres; returns its iteration."""
        by_distance = self._config.T_unit is IterationUnit.DISTANCE
        if (
            by_distance
            and self._began_m is not None
            and driven_m - self._began_m < self._config.iteration_m
        ):
            return self._number
        self._began_m = driven_m
        self._number += 1
        self._forget()
        return self._number

    def add(self, nodes: Iterable[int], succeeded: Iterable[bool]) -> None:
        """Remember attempts of the frame: dense indices and whether each was accepted."""
        for node, outcome in zip(nodes, succeeded, strict=True):
            self._latest.pop(node, None)
            self._latest[int(node)] = 2 * self._number + bool(outcome)

    @property
    def observations(self) -> Observations:
        """W and z now."""
        if self._config.T == 0:
            return Observations.none()
        count = len(self._latest)
        outcomes = np.fromiter(self._latest.values(), np.int64, count) & 1
        return Observations(
            np.fromiter(self._latest.keys(), np.int32, count), outcomes.astype(np.bool_)
        )

    def _forget(self) -> None:
        """Drops nodes last attempted before the last T iterations."""
        oldest = 2 * (self._number - self._config.T)
        for node in list(takewhile(lambda node: self._latest[node] < oldest, self._latest)):
            del self._latest[node]


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


class RunLog:
    """Collects the attempts of one session as it drives: the last 4,096 of 200 m at most.

    A failure without a prediction is not kept, as it says nothing: a lost robot has dozens per
    frame.
    """

    def __init__(self) -> None:
        self._columns = _columns(64)
        self._start = self._end = 0
        self._frames = 0

    def add(
        self,
        driven_m: float,
        nodes: Sequence[int],
        expected: tuple[NDArray[np.float64], NDArray[np.float64]],
        accepted: Sequence[bool],
        inliers: Sequence[int],
        landmarks: int,
    ) -> None:
        """Adds the R attempts of one frame.

        See `RunAttempts` for the arguments; `expected` holds `distance_m` and `rates`, (R,) float64
        each.
        """
        self._frames += len(nodes) > 0
        distances_m, rates = (values.tolist() for values in expected)
        tried = zip(nodes, distances_m, rates, accepted, inliers, strict=True)
        told = [one for one in tried if one[3] or not math.isnan(one[1])]
        if self._end + len(told) > len(self._columns[0]):
            self._make_room(driven_m, len(told))
        for row in told:
            for column, value in zip(self._columns, (driven_m, *row, landmarks), strict=True):
                column[self._end] = value
            self._end += 1

    def attempts(self, driven_m: float) -> RunAttempts:
        """The attempts remembered after `driven_m` metres of the session.

        Its arrays are views of data that never changes.
        """
        self._forget(driven_m)
        at_m, nodes, distance_m, rates, accepted, inliers, landmarks = (
            column[self._start : self._end] for column in self._columns
        )
        return RunAttempts(
            driven_m, at_m, nodes, distance_m, rates, accepted, inliers, landmarks, self._frames
        )

    def _forget(self, driven_m: float) -> None:
        at_m = self._columns[0][self._start : self._end]
        if len(at_m) and at_m[0] < driven_m - _REMEMBERED_M:
            self._start += int(np.searchsorted(at_m, driven_m - _REMEMBERED_M))
        self._start = max(self._start, self._end - _REMEMBERED)

    def _make_room(self, driven_m: float, count: int) -> None:
        self._forget(driven_m)
        kept = [column[self._start : self._end] for column in self._columns]
        self._start, self._end = 0, len(kept[0])
        self._columns = _columns(2 * (self._end + count))
        for column, values in zip(self._columns, kept, strict=True):
            column[: self._end] = values


def _columns(rows: int) -> list[NDArray[Any]]:
    """Empty columns in the order of `RunAttempts`."""
    kinds = (np.float64, np.int32, np.float64, np.float64, np.bool_, np.int64, np.int64)
    return [np.empty(rows, kind) for kind in kinds]
