"""How good is a map: pure functions of results (SPEC §8)."""

from engram.measures.accuracy import PoseErrors, pose_errors
from engram.measures.bootstrap import (
    Interval,
    Resamples,
    SessionSums,
    Statistic,
    difference,
    excess_ratio,
    product,
    ratio,
)
from engram.measures.comparison import beats
from engram.measures.failure import (
    FORMULAS,
    Drive,
    Estimator,
    Gaps,
    failure_curve,
    failure_gap,
    failure_lost,
    failure_route,
    failure_sums,
    gaps,
    longest_gap_m,
    not_localised_sums,
    route_m,
    route_not_localised,
)

__all__ = [
    "FORMULAS",
    "Drive",
    "Estimator",
    "Gaps",
    "Interval",
    "PoseErrors",
    "Resamples",
    "SessionSums",
    "Statistic",
    "beats",
    "difference",
    "excess_ratio",
    "failure_curve",
    "failure_gap",
    "failure_lost",
    "failure_route",
    "failure_sums",
    "gaps",
    "longest_gap_m",
    "not_localised_sums",
    "pose_errors",
    "product",
    "ratio",
    "route_m",
    "route_not_localised",
]
