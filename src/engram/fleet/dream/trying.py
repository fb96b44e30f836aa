"""Tries ways of merging in parallel: in this process, in several, or on a Dask cluster."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from engram.fleet.build.best_order import find_best_order
from engram.fleet.build.cluster import run_on_cluster
from engram.fleet.build.orders import JudgeOptions
from engram.fleet.merge.settings import MergeOptions
from engram.maps import copy_map
from engram.monitor import Monitor, Relay, write_whole
from engram.processes import run_in_processes
from engram.robot import Settings


@dataclass(frozen=True, slots=True)
class Try:
    """One method of merging, to be tried in all orders.

    Attributes:
        place: folder of its results; what is there already is not tried again.
        handed: the robots' maps.
        judge, settings, merging: see `find_best_order`.
        end_s: `time.time` at which trying ends; None: when all is tried.
    """

    place: Path
    handed: Sequence[Path]
    judge: JudgeOptions
    settings: Settings
    merging: MergeOptions
    end_s: float | None

    def count(self) -> int:
        """Number of orders."""
        return self.judge.orders.of(len(self.handed))


class _Deadline:
    """Stops work at a time, `time.time`; `over` says that it did."""

    def __init__(self, end_s: float | None) -> None:
        self._end_s = end_s
        self.over = False

    def check(self) -> None:
        if self._end_s is not None and time.time() >= self._end_s:
            self.over = True
            raise KeyboardInterrupt


def try_orders(asked: Try, monitor: Monitor) -> bool:
    """Tries the orders of one method of merging; whether it came to the end.

    Raises:
        KeyboardInterrupt: the monitor stopped it, rather than the time.
    """
    deadline = _Deadline(asked.end_s)
    watched = Relay(monitor, deadline.check)
    try:
        watched.check()
        find_best_order(
            asked.handed, asked.place, asked.settings, asked.merging, asked.judge, watched
        )
    except KeyboardInterrupt:
        if not deadline.over:
            raise
    return not deadline.over


def try_all(
    asked: Mapping[str, Try], workers: int, scheduler: str | None, monitor: Monitor
) -> bool:
    """Tries all ways of merging; whether all came to the end.

    Args:
        asked: ways of merging by name.
        workers: processes on this machine; with one, all is tried here.
        scheduler: address of a Dask scheduler, whose workers try instead; they read the validation
            drives themselves, and get the maps over the network.
        monitor: receives progress per order, and may stop it.

    Raises:
        KeyboardInterrupt: the monitor stopped it.
        WorkerError: workers died repeatedly, or the scheduler cannot be reached.
    """
    if scheduler is None and workers == 1:
        return all(try_orders(one, monitor) for one in asked.values())
    ended: list[bool] = []
    with monitor.stage("try orders", sum(one.count() for one in asked.values())) as stage:
        if scheduler is not None:
            _on_cluster(asked, scheduler, stage, ended.append)
        else:
            run_in_processes(
                try_orders, asked, workers, stage, lambda _, end, __: ended.append(end)
            )
    return all(ended)


@dataclass(frozen=True, slots=True)
class _FarTry:
    """A `Try` for a machine that shares no disk with this one, with its maps and results so far."""

    asked: Try
    maps: Sequence[bytes]
    results: Mapping[str, bytes]


def _on_cluster(
    asked: Mapping[str, Try], scheduler: str, monitor: Monitor, ended: Callable[[bool], None]
) -> None:
    maps = _whole_maps(next(iter(asked.values())).handed)
    tasks = {name: _FarTry(one, maps, _results_in(one.place)) for name, one in asked.items()}

    def done(name: str, made: tuple[bool, Mapping[str, bytes]]) -> None:
        end, results = made
        _write_results(asked[name].place, results)
        ended(end)

    run_on_cluster(_try_far_away, tasks, scheduler, monitor, done)


def _try_far_away(far: _FarTry, monitor: Monitor) -> tuple[bool, Mapping[str, bytes]]:
    """Runs in a worker of the cluster; returns whether it came to the end, and all results."""
    with tempfile.TemporaryDirectory(prefix="engram-dream-") as folder:
        handed = [Path(folder) / f"{number}.engram" for number in range(len(far.maps))]
        for path, content in zip(handed, far.maps, strict=True):
            path.write_bytes(content)
        place = Path(folder) / "results"
        _write_results(place, far.results)
        ended = try_orders(replace(far.asked, place=place, handed=handed), monitor)
        return ended, _results_in(place)


def _whole_maps(paths: Sequence[Path]) -> list[bytes]:
    """The maps' files, without a write-ahead log next to them."""
    with tempfile.TemporaryDirectory(prefix="engram-dream-") as folder:
        made = []
        for number, path in enumerate(paths):
            copy = Path(folder) / f"{number}.engram"
            copy_map(path, copy)
            made.append(copy.read_bytes())
    return made


def _results_in(place: Path) -> dict[str, bytes]:
    return {one.name: one.read_bytes() for one in sorted(place.glob("order-*.json"))}


def _write_results(place: Path, results: Mapping[str, bytes]) -> None:
    place.mkdir(parents=True, exist_ok=True)
    for name, content in results.items():
        with write_whole(place / name) as draft:
            draft.write_bytes(content)
