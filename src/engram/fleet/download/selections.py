"""Which nodes go along: the policies of DOWNLOAD (method §7, [G16] §V-B).

Selections by time of day; where an hour has no data they widen, and say so. They widen step by step
to the nearest hours with data, and finally to all nodes, so that a robot never sets out without a
map. `DownloadOptions.strict` refuses instead.

Which paths matter at which time of day ([G16] §V-B.3, Algorithms 2 and 3; method §7). Epochs are
stretches of the day of one length, half-open: a node on a boundary belongs to the later one. The
last epoch of the day is shorter if the length does not divide 24 hours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram.counts import counted
from engram.errors import ConfigError, InputError
from engram.fleet.download.coverage import Coverage, Demand, greedy_order
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.part import Mask, Stock
from engram.graph.model import PathId

MINUTES_PER_DAY = 1440.0
# Minutes (60 µs): rounding may put a stamp on a boundary just before it.
_ROUNDING_MIN = 1e-6

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PathCounts:
    """PCM: number of nodes of each path by epoch of the day (Algorithm 2).

    Attributes:
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
    """
    filled = np.flatnonzero(counts.counts.sum(axis=0))
    if not len(filled):
        raise InputError(
            "no path has a node with a known hour of day: paths cannot be weighted by time; "
            "use --select copy, region or route"
        )
    epochs = _between(depart_h, arrive_h, buffer_min, counts.epoch_min, filled)
    wider = [epoch for epoch in epochs if epoch in set(filled.tolist())]
    if not wider:
        raise InputError(
            f"no epoch from {_told(depart_h, 'first')} to {_told(arrive_h, 'last')} has data; "
            f"there is some from {_spans(filled.tolist(), counts.epoch_min)}: choose other times, "
            "or widen them with --set download.buffer_min=MINUTES"
        )
    return wider


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
    return f"the {otherwise}" if hour is None else _minutes_text(hour * 60)


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
    return _minutes_text(min(epoch * epoch_min, MINUTES_PER_DAY))


def _minutes_text(minutes: float) -> str:
    return f"{int(minutes) // 60}:{int(minutes) % 60:02d}"


_HOURS = 24.0
# Half a day either way is the whole day.
_WIDEST_MIN = 720.0
# Stamps are exact to the nanosecond; this covers rounding, hours.
_ROUNDING_H = 1e-9


def near_start(stock: Stock, options: DownloadOptions, where: Mask) -> tuple[Mask, dict[str, Any]]:
    """(N,) bool, nodes of some places within the window of the mission's start; and facts.

    Args:
        where: (N,) bool, the nodes of its route or region.
    """
    if options.depart_h is None:
        raise ConfigError(f"selection {options.select} needs --depart, the mission's time of day")
    hours = stock.known_hours()
    apart_h = np.abs(hours - options.depart_h)
    apart_h = np.nan_to_num(np.minimum(apart_h, _HOURS - apart_h), nan=np.inf)
    facts: dict[str, Any] = {"nodes_without_hour": int(np.isnan(hours[where]).sum())}
    for window_min in _windows(options.window_min, options):
        sent = where & (apart_h <= window_min / 60 + _ROUNDING_H)
        if sent.any():
            return sent, facts | _widened(options, options.window_min, window_min)
    if options.strict:
        raise InputError(
            f"no node was saved within {options.window_min:.0f} minutes of "
            f"{_hour_text(options.depart_h)}; widen it with --set download.window_min=MINUTES, or "
            "leave out --strict"
        )
    return where, facts | _everything(options)


def best_paths(
    stock: Stock, options: DownloadOptions, counted: Mask
) -> tuple[list[PathId], dict[str, Any]]:
    """The best paths of the mission's epochs, by counts over some nodes; and facts."""
    counts = count_paths(stock.on_path, stock.hours, options.epoch_min, counted)
    epochs, facts = _epochs(counts, options)
    rows = sorted({row for epoch in epochs for row in counts.best(epoch, options.best_percent)})
    chosen = [counts.paths[row] for row in rows]
    return chosen, {"epochs": epochs, "paths": [str(path) for path in chosen], **facts}


def _epochs(counts: PathCounts, options: DownloadOptions) -> tuple[list[int], dict[str, Any]]:
    """The mission's epochs with data, wider if there are none."""
    refused: InputError | None = None
    for buffer_min in _windows(options.buffer_min, options):
        mission = replace(options, buffer_min=buffer_min)
        try:
            found = mission_epochs(counts, mission.depart_h, mission.arrive_h, buffer_min)
        except InputError as error:
            refused = refused or error
        else:
            return found, _widened(options, options.buffer_min, buffer_min)
    if options.strict or not counts.counts.any():
        assert refused is not None
        raise refused
    return np.flatnonzero(counts.counts.sum(axis=0)).tolist(), _everything(options)


def _windows(asked_min: float, options: DownloadOptions) -> Iterator[float]:
    """The requested width, then wider ones up to half a day; only the requested one if `strict`."""
    yield asked_min
    while not options.strict and asked_min < _WIDEST_MIN:
        asked_min = min(asked_min + options.widen_min, _WIDEST_MIN)
        yield asked_min


def _widened(options: DownloadOptions, asked_min: float, found_min: float) -> dict[str, Any]:
    if found_min == asked_min:
        return {}
    mission = _mission(options)
    near = f"within {asked_min:.0f} minutes of {mission}" if asked_min else f"at {mission}"
    return {"widened": f"nothing was saved {near}: widened to {found_min:.0f} minutes around it"}


def _everything(options: DownloadOptions) -> dict[str, Any]:
    return {"widened": f"nothing was saved near {_mission(options)}: all hours are sent"}


def _mission(options: DownloadOptions) -> str:
    ends = [_hour_text(hour) for hour in (options.depart_h, options.arrive_h) if hour is not None]
    return " to ".join(dict.fromkeys(ends)) or "the mission"


def _hour_text(hour: float) -> str:
    minutes = round(60 * hour) % (24 * 60)
    return f"{minutes // 60}:{minutes % 60:02d}"


_DEFAULTS = asdict(DownloadOptions())


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The nodes of a download.

    Attributes:
        sent: (N,) bool, which nodes of the stock are sent.
        order: for `budget`: (N,) nodes by gain, of which a first part is sent; else None.
        coverage: the forecast that the selection used; else None.
    """

    sent: Mask
    why: Mapping[str, Any]
    order: NDArray[np.int64] | None = None
    coverage: Coverage | None = None


Policy: TypeAlias = Callable[[Stock, DownloadOptions], Selection]


def select_copy(stock: Stock, _: DownloadOptions) -> Selection:
    """All nodes. [G16] (3)."""
    return Selection(stock.everything(), {})


def select_tod(stock: Stock, options: DownloadOptions) -> Selection:
    """Nodes whose time of day is within a window of the mission's start, across midnight if needed.

    Source: [G16] (4); method §7.
    """
    return Selection(*near_start(stock, options, stock.area))


def select_paths(stock: Stock, options: DownloadOptions) -> Selection:
    """All nodes of the best paths of each of the mission's epochs. [G16] Algorithms 2 and 3."""
    stock.known_hours()
    chosen, why = best_paths(stock, options, stock.area)
    return Selection(stock.area & _nodes_on(stock, chosen), why)


def select_tod_and_paths(stock: Stock, options: DownloadOptions) -> Selection:
    """Nodes that pass `tod` and lie on a path chosen by counts over those nodes (method §7)."""
    near, facts = near_start(stock, options, stock.area)
    chosen, why = best_paths(stock, options, near)
    return Selection(near & _nodes_on(stock, chosen), {**why, **facts})


def select_region(stock: Stock, options: DownloadOptions) -> Selection:
    """Nodes within `radius_m` of some nodes, along the edges."""
    if not options.near:
        raise ConfigError("selection region needs --near NODE, the beginning of a node's UUID")
    return Selection(stock.area, {"seeds": stock.seeds})


def select_route(stock: Stock, options: DownloadOptions) -> Selection:
    """Nodes within `radius_m` of the path of one session, along the edges."""
    if options.route is None:
        raise ConfigError(
            "selection route needs --route SESSION, the beginning of a session's UUID"
        )
    return Selection(stock.area, {})


def select_budget(stock: Stock, options: DownloadOptions) -> Selection:
    """Nodes by the failures that they are expected to spare the mission, per byte.

    How many of them fit into the budget is found when the map is written.
    """
    if options.budget_bytes is None and options.budget_percent is None:
        raise ConfigError("selection budget needs --budget SIZE, such as 200MB or 25%")
    if options.depart_h is not None:
        stock.known_hours()
    coverage = coverage_for(stock, options)
    landmarks, thumbnails = stock.sizes
    size = landmarks + thumbnails * options.with_thumbnails
    order, _ = greedy_order(coverage, size.astype(np.float64), _spare_order(stock, options))
    return Selection(stock.everything(), {"demand": coverage.demand.total}, order, coverage)


SELECTIONS: dict[str, Policy] = {
    "copy": select_copy,
    "tod": select_tod,
    "paths": select_paths,
    "tod+paths": select_tod_and_paths,
    "region": select_region,
    "route": select_route,
    "budget": select_budget,
}

# The options that each selection uses; all use the mission's time (for the forecast), `thumbnails`.
UNDERSTOOD: dict[str, frozenset[str]] = {
    "copy": frozenset(),
    "tod": frozenset({"near", "route", "strict"}),
    "paths": frozenset({"near", "route", "strict"}),
    "tod+paths": frozenset({"near", "route", "strict"}),
    "region": frozenset({"near"}),
    "route": frozenset({"route"}),
    "budget": frozenset({"budget_bytes", "budget_percent", "near", "route"}),
}
_FLAGS = {
    "budget_bytes": "--budget",
    "budget_percent": "--budget",
    "near": "--near",
    "route": "--route",
    "strict": "--strict",
}
# Selections whose mission may have an end and no start: it starts with the first epoch with data.
_OPEN_START = frozenset({"paths", "tod+paths"})


def check_options(options: DownloadOptions) -> None:
    """Refuses options that a selection would ignore."""
    select = options.select
    if select not in SELECTIONS:
        raise ConfigError(f"selection {select!r} is unknown; known: {', '.join(SELECTIONS)}")
    for name, flag in _FLAGS.items():
        if getattr(options, name) == _DEFAULTS[name] or name in UNDERSTOOD[select]:
            continue
        *others, last = [
            selection for selection, understood in UNDERSTOOD.items() if name in understood
        ]
        takers = f"{', '.join(others)} or {last}" if others else last
        raise ConfigError(
            f"selection {select} does not use {flag}; leave it out, or choose --select {takers}"
        )
    _check_where(options)
    if options.depart_h is None:
        _check_no_mission(options)


def _check_where(options: DownloadOptions) -> None:
    if options.near and options.route is not None:
        raise ConfigError("a mission is along --route or around --near; give only one of them")


def _check_no_mission(options: DownloadOptions) -> None:
    """Refuses options about a mission's time if it has no start."""
    if options.arrive_h is not None and options.select not in _OPEN_START:
        raise ConfigError(f"selection {options.select} needs --depart with --arrive")
    if options.date is not None:
        raise ConfigError("--date gives the height of the sun at --depart; give both")


def coverage_for(stock: Stock, options: DownloadOptions) -> Coverage:
    """The forecast for a mission: its expected needs, and the gain of each node."""
    return Coverage(stock, Demand.of(stock, options))


def facts_told(why: Mapping[str, Any]) -> list[str]:
    """Lines for people on the facts of a selection: what it widened, chose and left out."""
    lines = []
    if widened := why.get("widened"):
        lines.append(widened)
    if epochs := why.get("epochs"):
        lines.append(f"epochs {epochs[0]} to {epochs[-1]}; paths chosen: {len(why['paths'])}")
    if unknown := why.get("nodes_without_hour"):
        lines.append(f"{counted(unknown, 'node')} left out: hour of day unknown")
    return lines


def _nodes_on(stock: Stock, paths: list[PathId]) -> Mask:
    sent = np.zeros(len(stock), np.bool_)
    for path in paths:
        sent[stock.on_path[path]] = True
    return sent


def _spare_order(stock: Stock, options: DownloadOptions) -> NDArray[np.int64]:
    """All nodes, those nearest in time of day first: they fill the rest of a budget."""
    if options.depart_h is None:
        return np.arange(len(stock))
    apart = np.abs(stock.hours - options.depart_h)
    apart = np.nan_to_num(np.minimum(apart, _HOURS - apart), nan=_HOURS)
    return np.argsort(apart, kind="stable")
