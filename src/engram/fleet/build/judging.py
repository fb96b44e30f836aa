"""By what the orders of merging are judged, and which of them are tried."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TypeAlias

from engram.config import config_hash, to_dict
from engram.robot import DriveSequence, OpenMap, Settings, open_drive, session_of_drive
from engram.errors import ConfigError
from engram.graph.model import Session
from engram.fleet.merge.gate import GateOptions, held_as
from engram.measures import Drive

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
