"""How the maps of the orders of merging fare, and what trying them took."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

from engram.fleet.build.judging import Orders


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

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> OrderResult:
        """From plain values."""
        return OrderResult(**{**values, "order": tuple(values["order"])})

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
        return BestOrder([OrderResult.from_dict(one) for one in values["orders"]], **kept)

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
