"""The recent attempts W and their outcomes z, over the last T iterations (method §3.6, §4)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from itertools import takewhile
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds


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
    ] = 10
    T_unit: Annotated[
        IterationUnit,
        Meta(
            description="distance makes one iteration of all frames within iteration_m of its "
            "first, so that the memory does not depend on the frame rate; frame makes one of each, "
            "as the paper does. Source: method §3.6"
        ),
    ] = IterationUnit.DISTANCE
    iteration_m: Annotated[
        float, Meta(gt=0, description="length of an iteration, m. Source: method §3.6")
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
