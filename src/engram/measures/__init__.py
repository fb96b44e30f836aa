"""How good is a map: pure functions of results (SPEC §8)."""

from engram.measures.failure import (
    Drive,
    Gaps,
    failure_gap,
    failure_lost,
    failure_route,
    gaps,
    longest_gap_m,
    route_m,
    route_not_localised,
)

__all__ = [
    "Drive",
    "Gaps",
    "failure_gap",
    "failure_lost",
    "failure_route",
    "gaps",
    "longest_gap_m",
    "route_m",
    "route_not_localised",
]
