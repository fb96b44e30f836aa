"""The best order of merging k groups: all k! of them, over a prefix tree ([G16] §VI-E, SPEC §7)."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from engram.drive import DriveSequence, OpenMap, Settings, open_drive
from engram.errors import ConfigError
from engram.fleet.docking import merge_maps
from engram.fleet.gate import GateOptions, localise_drive
from engram.fleet.merging import Progress
from engram.fleet.replay import MergeOptions
from engram.measures import Drive, failure_curve, failure_route, route_not_localised
from engram.store import MapStore

# [G16] §VI-E compares whole curves; ties at the distance judged by fall to the area to here.
_AREA_TO_M = 50.0
_AREA_STEP_M = 0.5
_SPREAD_AT_M = (5.0, 10.0, 20.0)
_REPORTED_AT_M = np.arange(0.0, _AREA_TO_M + _AREA_STEP_M / 2, _AREA_STEP_M)
# 5,040 orders of 7 groups are a matter of days.
_MOST_GROUPS = 6


Localise: TypeAlias = Callable[[OpenMap, DriveSequence, Settings, GateOptions], Drive]


@dataclass(frozen=True, slots=True)
class JudgeOptions:
    """By what an order is judged.

    Attributes:
        drives: validation sessions; no part of the groups, and of no report of quality.
        judge_at_m: distance x that the operator can bear on dead reckoning: the order with the
            lowest P(X ≥ x) is best.
        localising: policy and budget of the validation.
        reported: further sessions, which choose nothing: how they fare tells how good the chosen
            order is.
        localise: how a drive is localised in a map; None for `localise_drive`.
    """

    drives: Sequence[Path]
    judge_at_m: float = 10.0
    localising: GateOptions = field(default_factory=GateOptions)
    reported: Sequence[Path] = ()
    localise: Localise | None = None

    def __post_init__(self) -> None:
        if not self.drives:
            raise ConfigError("the best order is judged by validation drives: name at least one")
        if not 0 <= self.judge_at_m < math.inf:
            raise ConfigError(f"judge_at_m is {self.judge_at_m}, must be finite and >= 0")


@dataclass(frozen=True, slots=True)
class OrderResult:
    """One order and how the validation drives fare in its map.

    Attributes:
        order: numbers of the groups.
        judged: P(X ≥ x) at the distance judged by.
        area_m: area under the failure curve to 50 m.
        at_m: P(X ≥ x) at 5, 10 and 20 m, by distance.
        nodes: of the map.
        content_hash: of the map.
        reported: P(X ≥ x) of the sessions that choose nothing, every half metre from 0 to 50;
            empty where there are none.
        reported_missed: share of their way without a match.
    """

    order: tuple[int, ...]
    judged: float
    area_m: float
    at_m: dict[str, float]
    nodes: int
    content_hash: str
    reported: list[float] = field(default_factory=list)
    reported_missed: float = 0.0

    @property
    def rank(self) -> tuple[float, float, tuple[int, ...]]:
        """Best first; the order itself where two are alike."""
        return self.judged, self.area_m, self.order


@dataclass(slots=True)
class BestOrder:
    """All orders of some groups.

    Attributes:
        results: one per order, best first.
        judge_at_m: what they were judged by.
        merges, copies: made in this search.
        merge_s, copy_s, judge_s: wall time of those and of judging, seconds.
        replayed, attempts, lookups: nodes that were replayed in merging, match attempts, and
            nodes for which the relocaliser was asked.
    """

    results: list[OrderResult] = field(default_factory=list)
    judge_at_m: float = 10.0
    merges: int = 0
    copies: int = 0
    merge_s: float = 0.0
    copy_s: float = 0.0
    judge_s: float = 0.0
    replayed: int = 0
    attempts: int = 0
    lookups: int = 0

    @property
    def order(self) -> tuple[int, ...]:
        """The best."""
        return self.results[0].order

    def spread(self) -> dict[str, dict[str, float]]:
        """P(X ≥ x) at 5, 10 and 20 m over the orders: least, median, most, and of the best."""
        found = {}
        for at in self.results[0].at_m:
            values = [one.at_m[at] for one in self.results]
            found[at] = {
                "least": min(values),
                "median": float(np.median(values)),
                "most": max(values),
                "best": self.results[0].at_m[at],
            }
        return found

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "order": list(self.order),
            "judge_at_m": self.judge_at_m,
            "orders": [asdict(one) for one in self.results],
            "spread": self.spread(),
            "merges": self.merges,
            "copies": self.copies,
            "merge_s": self.merge_s,
            "copy_s": self.copy_s,
            "judge_s": self.judge_s,
            "replayed": self.replayed,
            "attempts": self.attempts,
            "lookups": self.lookups,
        }

    def text(self) -> str:
        """For people."""
        told = " ".join(map(str, self.order))
        lines = [
            f"best of {len(self.results)} orders: {told}, P(no match within "
            f"{self.judge_at_m:g} m) {self.results[0].judged:.2%}; {self.merges} merges in "
            f"{self.merge_s:.1f} s, {self.copies} copies in {self.copy_s:.1f} s, judging "
            f"{self.judge_s:.1f} s"
        ]
        lines += [
            f"  P(X >= {at} m): least {one['least']:.2%}, median {one['median']:.2%}, most "
            f"{one['most']:.2%}, best order {one['best']:.2%}"
            for at, one in self.spread().items()
        ]
        return "\n".join(lines)


def find_best_order(
    maps: Sequence[Path],
    folder: Path,
    settings: Settings,
    merging: MergeOptions,
    judge: JudgeOptions,
    progress: Progress,
) -> BestOrder:
    """Merges groups in every order and judges the results.

    Merges of a common prefix are made once and copied: k! orders of k groups take
    Σ k!/(k−d)! over d = 2 … k merges, 60 for k = 4. The search walks the tree depth first, so that
    no more than k maps lie on the disk; results are kept, so that it can be interrupted.

    Args:
        maps: the groups' maps, by number.
        folder: for intermediate maps and results.
        settings: of the localiser.
        merging: policy and budget of the merges.
        judge: by what the best is told.
        progress: shows how it goes.

    Raises:
        ConfigError: more groups than all orders of them could be tried.
        KeyboardInterrupt: a merge was interrupted.
    """
    if not 1 <= len(maps) <= _MOST_GROUPS:
        raise ConfigError(
            f"{len(maps)} groups have {math.factorial(len(maps)):,} orders; at most {_MOST_GROUPS} "
            "groups can be tried in all orders"
        )
    folder.mkdir(parents=True, exist_ok=True)
    search = _Search(maps, folder, settings, merging, judge)
    with progress("try orders", math.factorial(len(maps))) as advance:
        search.below((), None, advance)
    search.found.results.sort(key=lambda one: one.rank)
    return search.found


class _Search:
    """The walk over the prefix tree."""

    def __init__(
        self,
        maps: Sequence[Path],
        folder: Path,
        settings: Settings,
        merging: MergeOptions,
        judge: JudgeOptions,
    ) -> None:
        self.found = BestOrder(judge_at_m=judge.judge_at_m)
        self._maps = maps
        self._folder = folder
        self._settings = settings
        self._merging = merging
        self._judge = judge
        self._localise = judge.localise or localise_drive
        self._sequences = [open_drive(path) for path in judge.drives]
        self._reported = [open_drive(path) for path in judge.reported]

    def below(
        self, prefix: tuple[int, ...], merged: Path | None, advance: Callable[[str], None]
    ) -> None:
        """All orders that begin so; `merged` is the map of the prefix."""
        if len(prefix) == len(self._maps):
            assert merged is not None
            self._keep(self._judged(prefix, merged))
            advance(" ".join(map(str, prefix)))
            return
        for number in range(len(self._maps)):
            order = (*prefix, number)
            if number in prefix:
                continue
            if (known := self._known_below(order)) is not None:
                self.found.results += known
                for one in known:
                    advance(" ".join(map(str, one.order)))
                continue
            with _Intermediate(self._folder, order) as place:
                self._make(place, number, merged)
                self.below(order, place, advance)

    def _make(self, place: Path, number: int, prefix: Path | None) -> None:
        """The map of an order: a copy of its prefix's, and one more group."""
        started = time.perf_counter()
        MapStore.copy(self._maps[number] if prefix is None else prefix, place)
        copied = time.perf_counter()
        self.found.copies += 1
        self.found.copy_s += copied - started
        if prefix is None:
            return
        (report,) = merge_maps(place, [self._maps[number]], self._settings, self._merging)
        if report.interrupted:
            raise KeyboardInterrupt
        self.found.merges += 1
        self.found.replayed += sum(one.taken + one.omitted for one in report.segments)
        self.found.attempts += report.match_attempts
        self.found.lookups += report.lookups
        self.found.merge_s += time.perf_counter() - copied

    def _judged(self, order: tuple[int, ...], place: Path) -> OrderResult:
        started = time.perf_counter()
        with OpenMap(MapStore.open(place)) as opened:
            drives, reported = (
                [
                    self._localise(opened, one, self._settings, self._judge.localising)
                    for one in sequences
                ]
                for sequences in (self._sequences, self._reported)
            )
            nodes, content_hash = len(opened.graph), opened.store.content_hash()
        steps = np.arange(0.0, _AREA_TO_M, _AREA_STEP_M) + _AREA_STEP_M / 2
        area_m = sum(failure_route(drives, float(at)) for at in steps) * _AREA_STEP_M
        self.found.judge_s += time.perf_counter() - started
        return OrderResult(
            order,
            failure_route(drives, self._judge.judge_at_m),
            float(area_m),
            {f"{at:g}": failure_route(drives, at) for at in _SPREAD_AT_M},
            nodes,
            content_hash,
            failure_curve(reported, _REPORTED_AT_M).tolist() if reported else [],
            route_not_localised(reported),
        )

    def _keep(self, result: OrderResult) -> None:
        self.found.results.append(result)
        draft = self._result_path(result.order).with_suffix(".part")
        draft.write_text(json.dumps({**asdict(result), "judge_at_m": self._judge.judge_at_m}))
        draft.replace(self._result_path(result.order))

    def _known_below(self, prefix: tuple[int, ...]) -> list[OrderResult] | None:
        """Results of all orders below a prefix from an earlier run; None if any is missing."""
        known = []
        for order in _orders(prefix, len(self._maps)):
            path = self._result_path(order)
            if not path.exists():
                return None
            values = json.loads(path.read_text())
            if values.pop("judge_at_m") != self._judge.judge_at_m:
                return None
            known.append(OrderResult(**{**values, "order": tuple(values["order"])}))
        return known

    def _result_path(self, order: tuple[int, ...]) -> Path:
        return self._folder / f"order-{'-'.join(map(str, order))}.json"


class _Intermediate:
    """A map that exists for as long as a part of the tree is walked."""

    def __init__(self, folder: Path, order: tuple[int, ...]) -> None:
        self._path = folder / f"order-{'-'.join(map(str, order))}.engram"

    def __enter__(self) -> Path:
        self._remove()
        return self._path

    def __exit__(self, *_: object) -> None:
        self._remove()

    def _remove(self) -> None:
        for beside in self._path.parent.glob(f"{self._path.name}*"):
            beside.unlink()


def _orders(prefix: tuple[int, ...], count: int) -> Iterator[tuple[int, ...]]:
    """All orders of `count` groups that begin with the prefix."""
    if len(prefix) == count:
        yield prefix
        return
    for number in range(count):
        if number not in prefix:
            yield from _orders((*prefix, number), count)


@dataclass(frozen=True, slots=True)
class OrderCosts:
    """What trying all orders costs, seconds.

    Attributes:
        model_s: numerator of (8): every order's merges made afresh.
        sequential_s: its denominator: every order built by mapping sequentially, but for the copy
            of the first group.
        tree_s: merges of a common prefix made once.
        sequential_tree_s: sequential building that shares its prefixes likewise.
    """

    model_s: float
    sequential_s: float
    tree_s: float
    sequential_tree_s: float


def order_costs(groups: int, group_s: float, merge_s: float, copy_s: float) -> OrderCosts:
    """The cost model of trying all orders ([G16] eq. (8), SPEC §7).

    Args:
        groups: k.
        group_s: T_G, mapping one group.
        merge_s: T_M, merging one group's map.
        copy_s: T_C, copying an intermediate map.
    """
    k, orders = groups, math.factorial(groups)
    inner = sum(orders // math.factorial(k - depth) for depth in range(2, k + 1))
    copies_s = (inner + k) * copy_s
    return OrderCosts(
        model_s=k * group_s + orders * (k - 1) * merge_s + k * (orders - 1) * copy_s,
        sequential_s=(orders * (k - 1) + 1) * group_s + (orders - 1) * copy_s,
        tree_s=k * group_s + inner * merge_s + copies_s,
        sequential_tree_s=(inner + k) * group_s + copies_s,
    )
