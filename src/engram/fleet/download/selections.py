"""Which nodes go along: the policies of DOWNLOAD (method §7, [G16] §V-B)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram.counts import counted
from engram.errors import ConfigError, InputError
from engram.fleet.download.by_time import best_paths, near_start
from engram.fleet.download.coverage import Coverage, Demand, greedy_order
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.stock import Mask, Stock
from engram.graph.model import PathId, path_id
from engram.maps.difference import edge_lengths

_HOURS = 24.0
_DEFAULTS = asdict(DownloadOptions())


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The nodes of a download.

    Attributes:
        sent: (N,) bool, which nodes of the stock are sent.
        why: facts of the selection, as plain data.
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
    return Selection(*near_start(stock, options, mission_area(stock, options)))


def select_paths(stock: Stock, options: DownloadOptions) -> Selection:
    """All nodes of the best paths of each of the mission's epochs. [G16] Algorithms 2 and 3."""
    stock.known_hours()
    where = mission_area(stock, options)
    chosen, why = best_paths(stock, options, where)
    return Selection(where & _nodes_on(stock, chosen), why)


def select_tod_and_paths(stock: Stock, options: DownloadOptions) -> Selection:
    """Nodes that pass `tod` and lie on a path chosen by counts over those nodes (method §7)."""
    near, facts = near_start(stock, options, mission_area(stock, options))
    chosen, why = best_paths(stock, options, near)
    return Selection(near & _nodes_on(stock, chosen), {**why, **facts})


def select_region(stock: Stock, options: DownloadOptions) -> Selection:
    """Nodes within `radius_m` of some nodes, along the edges."""
    if not options.near:
        raise ConfigError("selection region needs --near NODE, the beginning of a node's UUID")
    seeds = [stock.named_node(prefix) for prefix in options.near]
    return Selection(within(stock, np.array(seeds), options.radius_m), {"seeds": len(seeds)})


def select_route(stock: Stock, options: DownloadOptions) -> Selection:
    """Nodes within `radius_m` of the path of one session, along the edges."""
    if options.route is None:
        raise ConfigError(
            "selection route needs --route SESSION, the beginning of a session's UUID"
        )
    return Selection(along_route(stock, options.route, options.radius_m), {})


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
    order = greedy_order(coverage, size.astype(np.float64), _spare_order(stock, options))
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
    """Refuses options that a selection would ignore.

    Raises:
        ConfigError: the selection is unknown, does not use an option that was given, or needs
            another option with it.
    """
    select = options.select
    if select not in SELECTIONS:
        raise ConfigError(f"selection {select!r} is unknown; known: {', '.join(SELECTIONS)}")
    for name, flag in _FLAGS.items():
        if getattr(options, name) == _DEFAULTS[name] or name in UNDERSTOOD[select]:
            continue
        *others, last = [one for one, understood in UNDERSTOOD.items() if name in understood]
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
    has_area = options.route is not None or options.near
    where = mission_area(stock, options) if has_area else None
    return Coverage(stock, Demand.of(stock, options, where))


def mission_area(stock: Stock, options: DownloadOptions) -> Mask:
    """(N,) bool, the nodes of the mission's route or region; all without one."""
    if options.route is not None:
        return along_route(stock, options.route, options.radius_m)
    if options.near:
        return select_region(stock, options).sent
    return stock.everything()


def within(stock: Stock, seeds: NDArray[np.int64], radius_m: float) -> Mask:
    """(N,) bool, the nodes within a distance of any seed, along the edges."""
    from scipy.sparse.csgraph import dijkstra

    distance_m = dijkstra(
        edge_lengths(stock.graph), directed=False, indices=seeds, min_only=True, limit=radius_m
    )
    return np.asarray(np.isfinite(distance_m), np.bool_)


def along_route(stock: Stock, session: str, radius_m: float) -> Mask:
    """(N,) bool, the nodes within a distance of a session's path, along the edges.

    Raises:
        InputError: no session or several match the prefix, or its path has no node.
    """
    found = stock.store.named_session(session)
    seeds = stock.on_path.get(path_id(found.id))
    if seeds is None:
        raise InputError(f"session {found.id} of {found.robot} has no node on its path")
    return within(stock, np.unique(seeds), radius_m)


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
