"""This run's attempts with where they were made: what policies learn from while driving."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Attempts farther back say nothing about the light here, whatever the policy.
_REMEMBERED_M = 200.0


@dataclass(frozen=True, slots=True, eq=False)
class RunAttempts:
    """Attempts of the live session over the last 200 m, oldest first.

    Attributes:
        driven_m: odometry distance of the live session now.
        at_m: (R,) float64, that distance when each was made.
        nodes: (R,) int32, dense indices of the nodes attempted.
        rates: (R,) float64, g at the predicted offset: how likely a match was, had the appearance
            been compatible. NaN where there was no prediction (relocalisation).
        accepted: (R,) bool.
        inliers: (R,) int64.
        landmarks: (R,) int64, landmarks of the live frame.
    """

    driven_m: float
    at_m: NDArray[np.float64]
    nodes: NDArray[np.int32]
    rates: NDArray[np.float64]
    accepted: NDArray[np.bool_]
    inliers: NDArray[np.int64]
    landmarks: NDArray[np.int64]

    @staticmethod
    def none() -> RunAttempts:
        """Nothing attempted yet."""
        nothing = np.zeros(0)
        return RunAttempts(
            0.0,
            nothing,
            np.zeros(0, np.int32),
            nothing,
            np.zeros(0, np.bool_),
            np.zeros(0, np.int64),
            np.zeros(0, np.int64),
        )

    def __len__(self) -> int:
        return len(self.nodes)

    def newest(self, count: int) -> RunAttempts:
        """The last `count` of them at most."""
        if len(self) <= count:
            return self
        last = slice(len(self) - count, None)
        return RunAttempts(
            self.driven_m,
            self.at_m[last],
            self.nodes[last],
            self.rates[last],
            self.accepted[last],
            self.inliers[last],
            self.landmarks[last],
        )

    def decay(self, length_m: float) -> NDArray[np.float64]:
        """(R,) exp(−Δs / length) of the distance driven since each attempt."""
        return np.asarray(np.exp((self.at_m - self.driven_m) / length_m))

    def failure_weights(self) -> NDArray[np.float64]:
        """(R,) how much each failure tells against its experience: g, and 0 for successes.

        A failure far from the node was to be expected; one without a prediction tells nothing.
        """
        return np.where(self.accepted | np.isnan(self.rates), 0.0, self.rates)


class RunLog:
    """Collects the attempts of one session as it drives."""

    def __init__(self) -> None:
        self._dtype = np.dtype(
            [
                ("at_m", "f8"),
                ("nodes", "i4"),
                ("rates", "f8"),
                ("accepted", "?"),
                ("inliers", "i8"),
                ("landmarks", "i8"),
            ]
        )
        self._rows = np.zeros(64, self._dtype)
        self._start = self._end = 0

    def add(
        self,
        driven_m: float,
        node: int,
        rate: float,
        *,
        accepted: bool,
        inliers: int,
        landmarks: int,
    ) -> None:
        """Remember one attempt; see `RunAttempts` for what the arguments mean."""
        if self._end == len(self._rows):
            self._make_room(driven_m)
        self._rows[self._end] = (driven_m, node, rate, accepted, inliers, landmarks)
        self._end += 1

    def attempts(self, driven_m: float) -> RunAttempts:
        """What is remembered after `driven_m` metres of the session."""
        self._forget(driven_m)
        rows = self._rows[self._start : self._end]
        columns = (np.ascontiguousarray(rows[name]) for name in self._dtype.names or ())
        return RunAttempts(driven_m, *columns)

    def _forget(self, driven_m: float) -> None:
        rows = self._rows["at_m"][self._start : self._end]
        self._start += int(np.searchsorted(rows, driven_m - _REMEMBERED_M))

    def _make_room(self, driven_m: float) -> None:
        self._forget(driven_m)
        kept = self._rows[self._start : self._end]
        rows = np.zeros(max(64, 2 * len(kept)), self._dtype)
        rows[: len(kept)] = kept
        self._rows, self._start, self._end = rows, 0, len(kept)
