"""The best order of merging k groups: all k! orders over a prefix tree ([G16] §VI-E, method §7).

Or only the choice of the first group, which has the largest effect (lab/reports/fleet.md).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from engram.config import config_hash, to_dict
from engram.errors import ConfigError, MapError
from engram.files import remove_left_drafts
from engram.fleet.build.orders import (
    BestOrder,
    JudgeOptions,
    OrderResult,
    Orders,
    Spent,
    check_countable,
    check_held_out,
)
from engram.fleet.build.scratch import keeping, read_kept, write_kept
from engram.fleet.merge.merging import merge
from engram.fleet.merge.settings import MergeOptions
from engram.graph.model import Session
from engram.maps import Map, copy_map
from engram.measures import failure, route_not_localised
from engram.monitor import Monitor
from engram.robot import Settings, measure, open_drive

# [G16] §VI-E compares whole curves; the area up to here breaks ties at the judging distance.
_AREA_TO_M = 50.0
_AREA_STEP_M = 0.5
_SPREAD_AT_M = (5.0, 10.0, 20.0)
_REPORTED_AT_M = np.arange(0.0, _AREA_TO_M + _AREA_STEP_M / 2, _AREA_STEP_M)


def find_best_order(
    maps: Sequence[Path],
    folder: Path,
    settings: Settings,
    merging: MergeOptions,
    judge: JudgeOptions,
    monitor: Monitor,
    *,
    root: Path | None = None,
) -> BestOrder:
    """Merges groups in every order, or with each of them first, and judges the results.

    Merges of a common prefix are made once and copied: k! orders of k groups take
    Σ k!/(k−d)! over d = 2 … k merges, 60 for k = 4; with a root over d = 1 … k, 64. The search
    walks the tree depth first and keeps at most k maps on the disk. Results are stored with
    all that they depend on, so an interrupted search continues.

    Args:
        maps: the groups' maps, by number.
        folder: for intermediate maps and results.
        settings: of the localiser.
        merging: policy and budget of the merges.
        judge: how an order is judged.
        monitor: receives progress per order.
        root: the map that all orders begin with; None if each begins with its first group's.

    Raises:
        ConfigError: there are too many groups to try all orders, or a judging drive is in one of
            the maps.
        MapError: another process wrote to the root, or the folder cannot be written.
        StorageFullError: no space is left.
        KeyboardInterrupt: a merge was interrupted.
    """
    check_countable(len(maps), judge.orders)
    with keeping(folder):
        folder.mkdir(parents=True, exist_ok=True)
    search = _Search(maps, folder, settings, merging, judge, root)
    with monitor.stage("try orders", judge.orders.of(len(maps))) as stage:
        search.below((), root, stage)
    search.check_root()
    search.found.results.sort(key=lambda one: one.rank)
    return search.found


def results_in(folder: Path) -> list[OrderResult]:
    """Results of earlier searches in a folder, best first; all must have the same inputs."""
    found = []
    for path in sorted(folder.glob("order-*.json")):
        try:
            step = read_kept(path, _Step)
        except ConfigError:  # partial, after a power cut
            continue
        if step.result is not None:
            found.append(step.result)
    return sorted(found, key=lambda one: one.rank)


@dataclass(frozen=True, slots=True)
class _Step:
    """One node of the prefix tree: its map was made, and judged if it has all groups.

    Attributes:
        depends: hash of all inputs of its map and its judgement.
    """

    depends: str
    order: tuple[int, ...]
    spent: Spent
    result: OrderResult | None


class _Search:
    """The walk over the prefix tree."""

    def __init__(
        self,
        maps: Sequence[Path],
        folder: Path,
        settings: Settings,
        merging: MergeOptions,
        judge: JudgeOptions,
        root: Path | None,
    ) -> None:
        self.found = BestOrder(
            [], judge.judge_at_m, judge.orders, root is not None, estimator=judge.estimator
        )
        self._maps = maps
        self._folder = folder
        self._settings = settings
        self._merging = merging
        self._judge = judge
        self._root = root
        self._localise = judge.localise or measure
        mapped: list[tuple[Session, str]] = []
        hashes = []
        for path in (*maps, *([] if root is None else [root])):
            with Map.open(path) as store:
                mapped += [(one, f"in {path}") for one in store.sessions.values()]
                hashes.append(store.content_hash())
        check_held_out(judge, mapped)
        self._root_hash = None if root is None else hashes[-1]
        self._depends = config_hash(
            [hashes, self._root_hash, to_dict(settings), to_dict(merging), judge.hash()]
        )
        self._sequences = [open_drive(path) for path in judge.drives]
        self._reported = [open_drive(path) for path in judge.reported]
        with keeping(folder):
            remove_left_drafts(folder, "order-*")
            for left in folder.glob("order-*.engram*"):
                left.unlink()  # left by a killed run

    def below(self, prefix: tuple[int, ...], merged: Path | None, monitor: Monitor) -> None:
        """Tries all orders with this prefix; `merged` is the map of the prefix."""
        for number in self._judge.orders.following(prefix, len(self._maps)):
            order = (*prefix, number)
            if (known := self._known_from(order)) is not None:
                for step in known:
                    self._count(step, monitor)
                continue
            monitor.check()
            with _Intermediate(self._folder, order) as place:
                step = self._step(order, place, merged)
                write_kept(self._path(step.order), step)
                self._count(step, monitor)
                self.below(order, place, monitor)

    def check_root(self) -> None:
        """Checks that the judged maps are those that merging would give now."""
        if self._root is None:
            return
        with Map.open(self._root) as store:
            if store.content_hash() != self._root_hash:
                raise MapError(
                    f"{self._root} changed while orders of merging were tried, so the results no "
                    "longer apply; run the same command again"
                )

    def _step(self, order: tuple[int, ...], place: Path, prefix: Path | None) -> _Step:
        """The map of an order: a copy of its prefix's, and one more group."""
        started = time.perf_counter()
        added = self._maps[order[-1]]
        copy_map(added if prefix is None else prefix, place)
        costs: dict[str, Any] = {"copies": 1, "copy_s": time.perf_counter() - started}
        if prefix is not None:
            costs |= self._merge(place, added)
        result = None
        if len(order) == len(self._maps):
            started = time.perf_counter()
            result = self._judged(order, place)
            costs["judge_s"] = time.perf_counter() - started
        return _Step(self._depends, order, Spent(**costs), result)

    def _merge(self, place: Path, added: Path) -> dict[str, Any]:
        started = time.perf_counter()
        (report,) = merge(place, [added], self._merging, settings=self._settings)
        if report.interrupted:
            raise KeyboardInterrupt
        return {
            "merges": 1,
            "merge_s": time.perf_counter() - started,
            "replayed": sum(one.taken + one.omitted for one in report.segments),
            "attempts": report.match_attempts,
            "proposed": report.proposed_attempts,
            "lookups": report.lookups,
        }

    def _judged(self, order: tuple[int, ...], place: Path) -> OrderResult:
        with Map.open(place) as opened:
            drives, reported = (
                [
                    self._localise(opened, one, self._settings, self._judge.localising)
                    for one in sequences
                ]
                for sequences in (self._sequences, self._reported)
            )
            nodes, content_hash = len(opened.graph), opened.content_hash()
        steps = np.arange(0.0, _AREA_TO_M, _AREA_STEP_M) + _AREA_STEP_M / 2
        estimator = self._judge.estimator
        area_m = float(failure(drives, steps, estimator).sum()) * _AREA_STEP_M
        return OrderResult(
            order,
            float(failure(drives, self._judge.judge_at_m, estimator)),
            area_m,
            {f"{at:g}": float(failure(drives, at, estimator)) for at in _SPREAD_AT_M},
            nodes,
            content_hash,
            failure(reported, _REPORTED_AT_M).tolist() if reported else [],
            route_not_localised(reported),
        )

    def _count(self, step: _Step, monitor: Monitor) -> None:
        self.found.spent += step.spent
        if step.result is not None:
            self.found.results.append(step.result)
            monitor.advance(" ".join(map(str, step.order)))

    def _known_from(self, prefix: tuple[int, ...]) -> list[_Step] | None:
        """All steps from a prefix on, if earlier runs made them from the same inputs; else None."""
        known = []
        for order in _tree(prefix, len(self._maps), self._judge.orders):
            step = self._known(order)
            if step is None:
                return None
            known.append(step)
        return known

    def _known(self, order: tuple[int, ...]) -> _Step | None:
        """A step of an earlier run; None if there is none, or its file is not valid.

        A power cut may leave an empty or partial file: the step is then made again.
        """
        path = self._path(order)
        if not path.exists():
            return None
        try:
            step = read_kept(path, _Step)
        except ConfigError:
            return None
        if step.depends != self._depends:
            return None
        is_whole = (step.result is not None) == (len(order) == len(self._maps))
        return step if is_whole else None

    def _path(self, order: tuple[int, ...]) -> Path:
        return self._folder / f"order-{'-'.join(map(str, order))}.json"


class _Intermediate:
    """A map that exists while its part of the tree is walked."""

    def __init__(self, folder: Path, order: tuple[int, ...]) -> None:
        self._path = folder / f"order-{'-'.join(map(str, order))}.engram"

    def __enter__(self) -> Path:
        self._remove()
        return self._path

    def __exit__(self, *_: object) -> None:
        self._remove()

    def _remove(self) -> None:
        with keeping(self._path.parent):
            for beside in self._path.parent.glob(f"{self._path.name}*"):
                beside.unlink()


def _tree(prefix: tuple[int, ...], count: int, orders: Orders) -> Iterator[tuple[int, ...]]:
    """The nodes of the prefix tree of `count` groups from a prefix on, itself first."""
    yield prefix
    for number in orders.following(prefix, count):
        yield from _tree((*prefix, number), count, orders)
