"""This run's attempts with their positions, from which policies learn during the drive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
