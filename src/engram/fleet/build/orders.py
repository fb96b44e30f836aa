"""Orders of merging: which are tried, how they are judged, their results and costs.

Source: [G16] §VI-E, eq. (8); method §7.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from engram.config import config_hash, plain, to_dict
from engram.counts import counted
from engram.errors import ConfigError
from engram.fleet.merge.gate import held_as
from engram.graph.model import Session
from engram.maps.map import Map
from engram.measures import Drive, Estimator
from engram.robot.localisers import DriveSequence, session_of_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive

# 7 groups have 5,040 orders, which take days.
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
        """Number of orders."""
        return math.factorial(groups) if self is Orders.ALL else groups


Localise: TypeAlias = Callable[[Map, DriveSequence, Settings, RobotOptions], Drive]


@dataclass(frozen=True, slots=True)
class JudgeOptions:
    """How an order is judged.

    Attributes:
        drives: validation sessions, held out of the groups and of every reported figure.
        judge_at_m: longest acceptable distance x without a match, metres: the order with the
            lowest P(X ≥ x) is best.
        reported: test sessions, not used for the choice: they measure the quality of the chosen
            order.
        localise: how a drive is localised in a map; None for `measure`. Stored results are
            assumed to come from the same function.
        estimator: what P is taken over.
    """

    drives: Sequence[Path]
    judge_at_m: float = 10.0
    localising: RobotOptions = field(default_factory=RobotOptions)
    reported: Sequence[Path] = ()
    localise: Localise | None = None
    orders: Orders = Orders.ALL
    estimator: Estimator = Estimator.ROUTE

    def __post_init__(self) -> None:
        if not self.drives:
            raise ConfigError(
                "the best order is judged by validation drives: name some (--validate)"
            )
        if not 0 <= self.judge_at_m < math.inf:
            raise ConfigError(f"judge_at_m is {self.judge_at_m}, must be finite and >= 0")

    def hash(self) -> str:
        """Hash of all that a judgement depends on: drives, distance, localising.

        It leaves out which orders are tried, so that known judgements are reused.
        """
        sessions = [
            [str(session_of_drive(open_drive(path)).id) for path in paths]
            for paths in (self.drives, self.reported)
        ]
        judged = [self.judge_at_m, to_dict(self.localising)]
        if self.estimator is not Estimator.ROUTE:  # older judgements are of the route
            judged.append(self.estimator)
        return config_hash([*sessions, *judged])


def check_held_out(judge: JudgeOptions, mapped: Sequence[tuple[Session, str]]) -> None:
    """Refuses judging drives that are in a map, or given twice.

    Args:
        mapped: the sessions of the maps, each with its place in words.
    """
    where = {session.id: words for session, words in mapped}
    known = [session for session, _ in mapped]
    for path in (*judge.drives, *judge.reported):
        sequence = open_drive(path)
        held = held_as(sequence, known)
        if held is not None:
            raise ConfigError(
                f"{path} is given to --validate, but is {where[held.id]} (session {held.id} "
                f"of {held.robot}); give drives that are in no map, each once"
            )
        known.append(session_of_drive(sequence))
        where[known[-1].id] = f"the same drive as {path}"


def check_countable(groups: int, orders: Orders) -> None:
    """Refuses more groups than orders can be tried for."""
    if groups < 1:
        raise ConfigError("there are no groups to merge")
    if orders is Orders.ALL and groups > _MOST_GROUPS:
        raise ConfigError(
            f"{groups} groups have {math.factorial(groups):,} orders; at most {_MOST_GROUPS} "
            f"groups can be tried in all orders; --order best-first tries {groups}"
        )


@dataclass(frozen=True, slots=True)
class OrderResult:
    """One order and the results of the validation drives in its map.

    Attributes:
        judged: P(X ≥ x) at the distance judged by.
        area_m: area under the failure curve to 50 m.
        at_m: P(X ≥ x) by distance x, at 5, 10 and 20 m.
        reported: P(X ≥ x) of the test sessions, every half metre from 0 to 50; empty
            without such sessions.
        reported_missed: share of their route without a match.
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
        """Sort key: best first, ties by the order itself."""
        return self.judged, self.area_m, self.order


@dataclass(frozen=True, slots=True)
class Spent:
    """Cost of the search, steps of earlier runs included.

    Attributes:
        merge_s, copy_s, judge_s: wall time of those and of judging, seconds.
        replayed, attempts, proposed, lookups: nodes replayed in merging, match attempts,
            attempts at proposed nodes, and nodes for which the relocaliser ran.
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

    def __add__(self, other: Spent) -> Spent:
        return Spent(*(getattr(self, n) + getattr(other, n) for n in self.__slots__))


@dataclass(slots=True)
class BestOrder:
    """Orders of some groups, and their results.

    Attributes:
        results: one per order, best first.
        judge_at_m: distance x at which they were judged, metres.
        rooted: whether every order began with an existing fleet map, not with its first group.
        spent: cost of this search over all its runs; work undone by an interruption counts once.
    """

    results: list[OrderResult] = field(default_factory=list)
    judge_at_m: float = 10.0
    tried: Orders = Orders.ALL
    rooted: bool = False
    spent: Spent = field(default_factory=Spent)
    estimator: Estimator = Estimator.ROUTE

    @property
    def order(self) -> tuple[int, ...]:
        """The best order: numbers of the groups."""
        return self.results[0].order

    def spread(self) -> dict[str, dict[str, float]]:
        """P(X ≥ x) at 5, 10 and 20 m over the orders: lowest, median, highest, best order."""
        spreads = {}
        for at in self.results[0].at_m:
            values = [result.at_m[at] for result in self.results]
            spreads[at] = {
                "least": min(values),
                "median": float(np.median(values)),
                "most": max(values),
                "best": self.results[0].at_m[at],
            }
        return spreads

    def to_dict(self) -> dict[str, Any]:
        """What ``build --json`` prints."""
        return {
            "order": list(self.order),
            "judge_at_m": self.judge_at_m,
            "estimator": self.estimator,
            "tried": self.tried.value,
            "rooted": self.rooted,
            "orders": plain(self.results),
            "spread": self.spread(),
            **plain(self.spent),
        }

    def text(self) -> str:
        """The result as text."""
        order = " ".join(map(str, self.order))
        lines = [
            f"best of {counted(len(self.results), 'order')}: {order}, P(no match within "
            f"{self.judge_at_m:g} m, {self.estimator}) {self.results[0].judged:.2%}; "
            f"{counted(self.spent.merges, 'merge')} in {self.spent.merge_s:.1f} s, "
            f"{counted(self.spent.copies, 'copy')} in {self.spent.copy_s:.1f} s, "
            f"judging {self.spent.judge_s:.1f} s"
        ]
        lines += [
            f"  P(X >= {at} m, {self.estimator}): least {p['least']:.2%}, "
            f"median {p['median']:.2%}, most {p['most']:.2%}, best order {p['best']:.2%}"
            for at, p in self.spread().items()
        ]
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class OrderCosts:
    """What trying all orders costs, seconds.

    Attributes:
        model_s: numerator of (8): all merges of every order.
        sequential_s: its denominator: every order mapped sequentially, the first group
            copied.
        tree_s: the same as `model_s`, merges of a common prefix made once.
        sequential_tree_s: the same as `sequential_s`, common prefixes mapped once.
    """

    model_s: float
    sequential_s: float
    tree_s: float
    sequential_tree_s: float


def order_costs(groups: int, group_s: float, merge_s: float, copy_s: float) -> OrderCosts:
    """The cost model of trying all orders ([G16] eq. (8), method §7).

    Args:
        groups: k.
        group_s: T_G, mapping one group, seconds.
        merge_s: T_M, merging one group's map, seconds.
        copy_s: T_C, copying an intermediate map, seconds.
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
