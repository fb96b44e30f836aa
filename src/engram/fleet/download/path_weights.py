"""Which paths matter at which time of day ([G16] §V-B.3, Algorithms 2 and 3; method §7).

Epochs are stretches of the day of one length, half-open: a node on a boundary belongs to the later
one. The last epoch of the day is shorter if the length does not divide 24 hours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError
from engram.graph.model import PathId

MINUTES_PER_DAY = 1440.0
# Minutes (60 µs): rounding may put a stamp on a boundary just before it.
_ROUNDING_MIN = 1e-6

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PathCounts:
    """PCM: number of nodes of each path by epoch of the day (Algorithm 2).

    Attributes:
        paths: in the order of their UUIDs.
        counts: (P, K) int64.
        epoch_min: length Δt of an epoch, minutes.
    """

    paths: tuple[PathId, ...]
    counts: NDArray[np.int64]
    epoch_min: float

    @property
    def weights(self) -> Array:
        """PWM: (P, K) float64, each epoch's counts as shares; 0 for an empty epoch. [G16] (7)."""
        totals = self.counts.sum(axis=0)
        return np.asarray(self.counts / np.maximum(totals, 1), np.float64)

    def best(self, epoch: int, percent: float) -> list[int]:
        """Rows of the best share of an epoch's paths: those with most nodes, ties by UUID.

        Of n > 0 paths with a node in the epoch, max(1, ⌈percent·n/100⌉).
        """
        column = self.counts[:, epoch]
        used = sorted(np.flatnonzero(column).tolist(), key=lambda row: (-int(column[row]), row))
        share = math.ceil(percent * len(used) / 100 - 1e-9)
        return used[: max(1, share)]


def epoch_count(epoch_min: float) -> int:
    """Epochs of a day."""
    return math.ceil(MINUTES_PER_DAY / epoch_min - 1e-9)


def epoch_of(hours: Array, epoch_min: float) -> NDArray[np.int64]:
    """(N,) int64, the epoch of each hour of day; -1 for NaN (unknown).

    Source: [G16] (5), half-open (method §9): t_k = {t | k·Δt ≤ t < (k + 1)·Δt}, k from 0.
    """
    minutes = np.where(np.isnan(hours), -1.0, hours * 60.0 + _ROUNDING_MIN)
    epochs = np.floor(minutes / epoch_min).astype(np.int64)
    return np.where(np.isnan(hours), -1, np.minimum(epochs, epoch_count(epoch_min) - 1))


def count_paths(
    on_path: dict[PathId, NDArray[np.int64]],
    hours: Array,
    epoch_min: float,
    counted: NDArray[np.bool_] | None = None,
) -> PathCounts:
    """PCM(P, k): the nodes with a time in epoch k on path P. [G16] Algorithm 2.

    Args:
        on_path: for each path the nodes on it, each once: M(n, P) = 1.
        hours: (N,) hour of day of each node, NaN where unknown.
        epoch_min: length of an epoch, minutes.
        counted: (N,) which nodes count; None for all.
    """
    epochs = epoch_of(hours, epoch_min)
    if counted is not None:
        epochs = np.where(counted, epochs, -1)
    paths = tuple(sorted(on_path))
    counts = np.zeros((len(paths), epoch_count(epoch_min)), np.int64)
    for row, path in enumerate(paths):
        nodes = np.unique(on_path[path])
        known = epochs[nodes]
        np.add.at(counts[row], known[known >= 0], 1)
    return PathCounts(paths, counts, epoch_min)


def mission_epochs(
    counts: PathCounts,
    depart_h: float | None,
    arrive_h: float | None,
    buffer_min: float = 0.0,
) -> list[int]:
    """The epochs of a mission that have data. [G16] Algorithm 3, lines 1 to 6; method §7.

    A start that is missing or before the first epoch with data becomes that epoch; an end that is
    missing or after the last one becomes that one. A start later than the end runs over midnight
    and is not clamped. The buffer is applied first.

    Raises:
        InputError: no epoch of the mission has data.
    """
    filled = np.flatnonzero(counts.counts.sum(axis=0))
    if not len(filled):
        raise InputError(
            "no path has a node with a known hour of day: paths cannot be weighted by time; "
            "use --select copy, region or route"
        )
    epochs = _between(depart_h, arrive_h, buffer_min, counts.epoch_min, filled)
    found = [epoch for epoch in epochs if epoch in set(filled.tolist())]
    if not found:
        raise InputError(
            f"no epoch from {_told(depart_h, 'first')} to {_told(arrive_h, 'last')} has data; "
            f"there is some from {_spans(filled.tolist(), counts.epoch_min)}: choose other times, "
            "or widen them with --set download.buffer_min=MINUTES"
        )
    return found


def _between(
    depart_h: float | None,
    arrive_h: float | None,
    buffer_min: float,
    epoch_min: float,
    filled: NDArray[np.intp],
) -> list[int]:
    """The mission's epochs in the order of time."""
    if depart_h is not None and arrive_h is not None:
        span_min = (arrive_h - depart_h) * 60 % MINUTES_PER_DAY + 2 * buffer_min
        start_min = (depart_h * 60 - buffer_min) % MINUTES_PER_DAY
        if start_min + span_min >= MINUTES_PER_DAY:
            return _over_midnight(start_min, span_min, epoch_min)
        depart_h, arrive_h, buffer_min = start_min / 60, (start_min + span_min) / 60, 0.0
    start = _epoch_at(depart_h, -buffer_min, epoch_min)
    end = _epoch_at(arrive_h, buffer_min, epoch_min)
    first, last = int(filled[0]), int(filled[-1])
    begin = first if start is None or start < first else start
    stop = last if end is None or end > last else end
    return list(range(begin, stop + 1))


def _over_midnight(start_min: float, span_min: float, epoch_min: float) -> list[int]:
    day = epoch_count(epoch_min)
    end_min = start_min + span_min - MINUTES_PER_DAY
    start, end = epoch_of(np.array([start_min, end_min]) / 60, epoch_min).tolist()
    if end >= start or span_min >= MINUTES_PER_DAY:
        return list(range(day))
    return [*range(start, day), *range(end + 1)]


def _epoch_at(hour: float | None, shift_min: float, epoch_min: float) -> int | None:
    """The epoch of a time of day, shifted within its day; None if `hour` is."""
    if hour is None:
        return None
    minutes = min(max(hour * 60 + shift_min, 0.0), MINUTES_PER_DAY)
    return int(epoch_of(np.array([minutes / 60]), epoch_min)[0])


def _told(hour: float | None, otherwise: str) -> str:
    return f"the {otherwise}" if hour is None else _clock(hour * 60)


def _spans(epochs: list[int], epoch_min: float) -> str:
    """Stretches of epochs, one after another: "8:00 to 9:00, 16:00 to 18:00"."""
    breaks = [at for at in range(1, len(epochs)) if epochs[at] > epochs[at - 1] + 1]
    stretches = [
        (epochs[begin], epochs[end - 1])
        for begin, end in zip([0, *breaks], [*breaks, len(epochs)], strict=True)
    ]
    return ", ".join(
        f"{_epoch_text(first, epoch_min)} to {_epoch_text(last + 1, epoch_min)}"
        for first, last in stretches
    )


def _epoch_text(epoch: int, epoch_min: float) -> str:
    return _clock(min(epoch * epoch_min, MINUTES_PER_DAY))


def _clock(minutes: float) -> str:
    return f"{int(minutes) // 60}:{int(minutes) % 60:02d}"
