"""The best order of merging k groups: all k! of them, over a prefix tree ([G16] §VI-E, SPEC §7).

Or only which of them comes first, on which most depends (docs/results-fleet.md).
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from engram.config import config_hash, to_dict
from engram.drive import DriveSequence, OpenMap, Settings, open_drive, session_of_drive
from engram.errors import ConfigError, MapError
from engram.experience.model import Session
from engram.fleet.docking import merge_maps
from engram.fleet.gate import GateOptions, held_as, localise_drive
from engram.fleet.keeping import keeping
from engram.fleet.merging import Progress
from engram.fleet.replay import MergeOptions
from engram.measures import Drive, failure_curve, failure_route, route_not_localised
from engram.store import MapStore
from engram.store.drafts import remove_left_drafts

# [G16] §VI-E compares whole curves; ties at the distance judged by fall to the area to here.
_AREA_TO_M = 50.0
_AREA_STEP_M = 0.5
_SPREAD_AT_M = (5.0, 10.0, 20.0)
_REPORTED_AT_M = np.arange(0.0, _AREA_TO_M + _AREA_STEP_M / 2, _AREA_STEP_M)
# 5,040 orders of 7 groups are a matter of days.
_MOST_GROUPS = 6


class Orders(StrEnum):
    """Which orders of k groups are tried."""

    ALL = "all"  # k! of them
    FIRST = "first"  # k: each group comes first once, the others follow in their order

    def following(self, prefix: tuple[int, ...], groups: int) -> list[int]:
        """The groups that may come after a prefix."""
        left = [number for number in range(groups) if number not in prefix]
        return left if self is Orders.ALL or not prefix else left[:1]

    def of(self, groups: int) -> int:
        """How many orders there are."""
        return math.factorial(groups) if self is Orders.ALL else groups


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
        localise: how a drive is localised in a map; None for `localise_drive`. Results that a
            search finds from earlier are taken to be by the same.
        orders: which are tried.
    """

    drives: Sequence[Path]
    judge_at_m: float = 10.0
    localising: GateOptions = field(default_factory=GateOptions)
    reported: Sequence[Path] = ()
    localise: Localise | None = None
    orders: Orders = Orders.ALL

    def __post_init__(self) -> None:
        if not self.drives:
            raise ConfigError(
                "the best order is judged by validation drives: name some (--validate)"
            )
        if not 0 <= self.judge_at_m < math.inf:
            raise ConfigError(f"judge_at_m is {self.judge_at_m}, must be finite and >= 0")

    def hash(self) -> str:
        """Changes when any order could be judged otherwise: by drives, distance or localising.

        Not by which orders are tried: those that were judged need not be again.

        Raises:
            SequenceError: a drive cannot be read.
        """
        sessions = [
            [str(session_of_drive(open_drive(path)).id) for path in paths]
            for paths in (self.drives, self.reported)
        ]
        return config_hash([*sessions, self.judge_at_m, to_dict(self.localising)])


def check_held_out(judge: JudgeOptions, mapped: Sequence[tuple[Session, str]]) -> None:
    """Refuses to judge a map by what it was made of, or by one drive twice.

    Args:
        judge: the drives that must be held out.
        mapped: the sessions that none of them must be, and where each is, in words.

    Raises:
        ConfigError: a drive is not held out; names it.
        SequenceError: a drive cannot be read.
    """
    where = {one.id: words for one, words in mapped}
    known = [one for one, _ in mapped]
    for path in (*judge.drives, *judge.reported):
        sequence = open_drive(path)
        held = held_as(sequence, known)
        if held is not None:
            raise ConfigError(
                f"{path} judges the orders of merging, but is {where[held.id]} (session {held.id} "
                f"of {held.robot}); judge by drives that are in no map, and name each once"
            )
        known.append(session_of_drive(sequence))
        where[known[-1].id] = f"the same drive as {path}"


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


@dataclass(frozen=True, slots=True)
class Spent:
    """What a step of the search took; steps of earlier runs count like those of this one.

    Attributes:
        merges, copies: made.
        merge_s, copy_s, judge_s: wall time of those and of judging, seconds.
        replayed, attempts, proposed, lookups: see `BestOrder`.
    """

    merges: int = 0
    copies: int = 0
    merge_s: float = 0.0
    copy_s: float = 0.0
    judge_s: float = 0.0
    replayed: int = 0
    attempts: int = 0
    proposed: int = 0
    lookups: int = 0


@dataclass(slots=True)
class BestOrder:
    """Orders of some groups, and how they fare.

    Attributes:
        results: one per order, best first.
        judge_at_m: what they were judged by.
        tried: which orders of the groups.
        rooted: whether every order began with a centre that was there, not with its first group.
        merges, copies: made in this search, in all its runs; what an interruption undid is
            counted once.
        merge_s, copy_s, judge_s: wall time of those and of judging, seconds.
        replayed, attempts, proposed, lookups: nodes that were replayed in merging, match attempts,
            those of them at proposed nodes, and nodes for which the relocaliser was asked.
    """

    results: list[OrderResult] = field(default_factory=list)
    judge_at_m: float = 10.0
    tried: Orders = Orders.ALL
    rooted: bool = False
    merges: int = 0
    copies: int = 0
    merge_s: float = 0.0
    copy_s: float = 0.0
    judge_s: float = 0.0
    replayed: int = 0
    attempts: int = 0
    proposed: int = 0
    lookups: int = 0

    def count(self, spent: Spent) -> None:
        """One more step."""
        for one in fields(Spent):
            setattr(self, one.name, getattr(self, one.name) + getattr(spent, one.name))

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> BestOrder:
        """From what `to_dict` gave."""
        kept = {one.name: values[one.name] for one in fields(BestOrder) if one.name in values}
        kept["tried"] = Orders(kept.get("tried", Orders.ALL))  # builds of before tried all
        return BestOrder([_order_result(one) for one in values["orders"]], **kept)

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
            "tried": self.tried.value,
            "rooted": self.rooted,
            "orders": [asdict(one) for one in self.results],
            "spread": self.spread(),
            "merges": self.merges,
            "copies": self.copies,
            "merge_s": self.merge_s,
            "copy_s": self.copy_s,
            "judge_s": self.judge_s,
            "replayed": self.replayed,
            "attempts": self.attempts,
            "proposed": self.proposed,
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


def check_countable(groups: int, orders: Orders) -> None:
    """Refuses more groups than all orders of them could be tried.

    Raises:
        ConfigError: there are too many, or none.
    """
    if groups < 1:
        raise ConfigError("there are no groups to be merged in any order")
    if orders is Orders.ALL and groups > _MOST_GROUPS:
        raise ConfigError(
            f"{groups} groups have {math.factorial(groups):,} orders; at most {_MOST_GROUPS} "
            f"groups can be tried in all orders; --best-first tries {groups}"
        )


def find_best_order(
    maps: Sequence[Path],
    folder: Path,
    settings: Settings,
    merging: MergeOptions,
    judge: JudgeOptions,
    progress: Progress,
    *,
    root: Path | None = None,
) -> BestOrder:
    """Merges groups in every order, or with each of them first, and judges the results.

    Merges of a common prefix are made once and copied: k! orders of k groups take
    Σ k!/(k−d)! over d = 2 … k merges, 60 for k = 4; with a root over d = 1 … k, 64. The search
    walks the tree depth first, so that no more than k maps lie on the disk; results are kept with
    all that they depend on, so that it can be interrupted.

    Args:
        maps: the groups' maps, by number.
        folder: for intermediate maps and results.
        settings: of the localiser.
        merging: policy and budget of the merges.
        judge: by what the best is told.
        progress: shows how it goes.
        root: the map that all orders begin with; None where each begins with its first group's.

    Raises:
        ConfigError: more groups than all orders of them could be tried, or a drive that judges is
            in one of the maps.
        MapError: the root was written to meanwhile, or the folder cannot be written.
        StorageFullError: no space is left.
        KeyboardInterrupt: a merge was interrupted.
    """
    check_countable(len(maps), judge.orders)
    with keeping(folder):
        folder.mkdir(parents=True, exist_ok=True)
    search = _Search(maps, folder, settings, merging, judge, root)
    with progress("try orders", judge.orders.of(len(maps))) as advance:
        search.below((), root, advance)
    search.check_root()
    search.found.results.sort(key=lambda one: one.rank)
    return search.found


@dataclass(frozen=True, slots=True)
class _Step:
    """One node of the prefix tree: its map was made, and judged if it has all groups."""

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
        self.found = BestOrder([], judge.judge_at_m, judge.orders, root is not None)
        self._maps = maps
        self._folder = folder
        self._settings = settings
        self._merging = merging
        self._judge = judge
        self._root = root
        self._localise = judge.localise or localise_drive
        mapped: list[tuple[Session, str]] = []
        hashes = []
        for path in (*maps, *([] if root is None else [root])):
            with MapStore.open(path) as store:
                mapped += [(one, f"in {path}") for one in store.sessions()]
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
                left.unlink()  # by a run that was killed

    def below(
        self, prefix: tuple[int, ...], merged: Path | None, advance: Callable[[str], None]
    ) -> None:
        """All orders that begin so; `merged` is the map of the prefix."""
        for number in self._judge.orders.following(prefix, len(self._maps)):
            order = (*prefix, number)
            if (known := self._known_from(order)) is not None:
                for step in known:
                    self._count(step, advance)
                continue
            with _Intermediate(self._folder, order) as place:
                step = self._step(order, place, merged)
                self._keep(step)
                self._count(step, advance)
                self.below(order, place, advance)

    def check_root(self) -> None:
        """The maps that were judged are those that merging would give now."""
        if self._root is None:
            return
        with MapStore.open(self._root) as store:
            if store.content_hash() != self._root_hash:
                raise MapError(
                    f"{self._root} was written to while the orders were tried, so that they were "
                    "judged by what would not be built; give the same command again"
                )

    def _step(self, order: tuple[int, ...], place: Path, prefix: Path | None) -> _Step:
        """The map of an order: a copy of its prefix's, and one more group."""
        started = time.perf_counter()
        added = self._maps[order[-1]]
        MapStore.copy(added if prefix is None else prefix, place)
        costs: dict[str, Any] = {"copies": 1, "copy_s": time.perf_counter() - started}
        if prefix is not None:
            costs |= self._merge(place, added)
        result = None
        if len(order) == len(self._maps):
            started = time.perf_counter()
            result = self._judged(order, place)
            costs["judge_s"] = time.perf_counter() - started
        return _Step(order, Spent(**costs), result)

    def _merge(self, place: Path, added: Path) -> dict[str, Any]:
        started = time.perf_counter()
        (report,) = merge_maps(place, [added], self._settings, self._merging)
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

    def _count(self, step: _Step, advance: Callable[[str], None]) -> None:
        self.found.count(step.spent)
        if step.result is not None:
            self.found.results.append(step.result)
            advance(" ".join(map(str, step.order)))

    def _keep(self, step: _Step) -> None:
        path = self._path(step.order)
        draft = path.with_suffix(".part")
        with keeping(self._folder):
            draft.write_text(json.dumps({"depends": self._depends, **asdict(step)}))
            draft.replace(path)

    def _known_from(self, prefix: tuple[int, ...]) -> list[_Step] | None:
        """All steps from a prefix on, if earlier runs made them by the same; else None."""
        known = []
        for order in _tree(prefix, len(self._maps), self._judge.orders):
            step = self._known(order)
            if step is None:
                return None
            known.append(step)
        return known

    def _known(self, order: tuple[int, ...]) -> _Step | None:
        """A step of an earlier run; None without one, and where its file cannot be made sense of.

        A computer that lost power may leave a file empty or in part: the step is made again.
        """
        path = self._path(order)
        if not path.exists():
            return None
        with keeping(self._folder):
            content = path.read_bytes()
        try:
            values = json.loads(content)
            if values["depends"] != self._depends:
                return None
            result = values["result"]
            spent = Spent(**values["spent"])
            step = _Step(order, spent, None if result is None else _order_result(result))
        except (ValueError, TypeError, KeyError):
            return None
        is_whole = (step.result is not None) == (len(order) == len(self._maps))
        return step if is_whole else None

    def _path(self, order: tuple[int, ...]) -> Path:
        return self._folder / f"order-{'-'.join(map(str, order))}.json"


def _order_result(values: Mapping[str, Any]) -> OrderResult:
    """From plain values."""
    return OrderResult(**{**values, "order": tuple(values["order"])})


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
        with keeping(self._path.parent):
            for beside in self._path.parent.glob(f"{self._path.name}*"):
                beside.unlink()


def _tree(prefix: tuple[int, ...], count: int, orders: Orders) -> Iterator[tuple[int, ...]]:
    """The nodes of the prefix tree of `count` groups from a prefix on, itself first."""
    yield prefix
    for number in orders.following(prefix, count):
        yield from _tree((*prefix, number), count, orders)


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
