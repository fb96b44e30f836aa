"""One demand and whether it is met."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Check:
    """One demand on a policy, a reader or a kind of features.

    Attributes:
        demand: in words.
        met: whether it is met.
        found: what was found.
    """

    demand: str
    met: bool
    found: str


def unmet(checks: Iterable[Check]) -> list[str]:
    """The unmet demands, each with what was found; a test asserts that the list is empty."""
    return [f"{one.demand}: {one.found}" for one in checks if not one.met]
