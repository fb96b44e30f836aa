"""Selections by time of day; where an hour has no data they widen, and say so.

They widen step by step to the nearest hours with data, and finally to all nodes, so that a robot
never sets out without a map. `DownloadOptions.strict` refuses instead.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from engram.errors import ConfigError, InputError
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.path_weights import PathCounts, count_paths, mission_epochs
from engram.fleet.download.stock import Mask, Stock
from engram.graph.model import PathId

_HOURS = 24.0
# Half a day either way is the whole day.
_WIDEST_MIN = 720.0
# Stamps are exact to the nanosecond; this covers rounding, hours.
_ROUNDING_H = 1e-9


def near_start(stock: Stock, options: DownloadOptions, where: Mask) -> tuple[Mask, dict[str, Any]]:
    """(N,) bool, nodes of some places within the window of the mission's start; and facts.

    Args:
        stock: the fleet map.
        options: the mission.
        where: (N,) bool, the nodes of its route or region.

    Raises:
        ConfigError: the mission has no start.
        InputError: no hour is known; or, if `strict`, no node fits.
    """
    if options.depart_h is None:
        raise ConfigError(f"selection {options.select} needs --depart, the mission's time of day")
    hours = stock.known_hours()
    apart_h = np.abs(hours - options.depart_h)
    apart_h = np.nan_to_num(np.minimum(apart_h, _HOURS - apart_h), nan=np.inf)
    facts: dict[str, Any] = {"nodes_without_hour": int(np.isnan(hours).sum())}
    for window_min in _windows(options.window_min, options):
        sent = where & (apart_h <= window_min / 60 + _ROUNDING_H)
        if sent.any():
            return sent, facts | _widened(options, options.window_min, window_min)
    if options.strict:
        raise InputError(
            f"no node was saved within {options.window_min:.0f} minutes of "
            f"{_clock(options.depart_h)}; widen it with --set download.window_min=MINUTES, or "
            "leave out --strict"
        )
    return where, facts | _everything(options)


def best_paths(
    stock: Stock, options: DownloadOptions, counted: Mask
) -> tuple[list[PathId], dict[str, Any]]:
    """The best paths of the mission's epochs, by counts over some nodes; and facts.

    Raises:
        InputError: no counted node has a known hour; or, if `strict`, no epoch has data.
    """
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
    ends = [_clock(one) for one in (options.depart_h, options.arrive_h) if one is not None]
    return " to ".join(dict.fromkeys(ends)) or "the mission"


def _clock(hour: float) -> str:
    minutes = round(60 * hour) % (24 * 60)
    return f"{minutes // 60}:{minutes % 60:02d}"
