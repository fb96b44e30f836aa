"""Lines with 90 % bands over sessions, as both studies draw them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from engram.measures import Drive, Estimator, failure_sums
from engram_lab.charts import Line
from engram_lab.intervals import (
    Interval,
    Resamples,
    SessionSums,
    not_localised_sums,
    product,
)
from engram_lab.studies.pages import Row

# Where failure curves are drawn.
CURVE_AT_M = np.arange(0.0, 50.5, 0.5)


def failure_line(
    label: str,
    drives: Sequence[Drive],
    resamples: Resamples,
    estimator: Estimator = Estimator.ROUTE,
    *,
    scaled: bool = False,
) -> Line:
    """P(X ≥ x) in per cent.

    Args:
        label: of the line.
        drives: one per session.
        resamples: draws of sessions.
        estimator: of P.
        scaled: times the share of the route that is not localised (method §8).
    """
    parts = [failure_sums(one, CURVE_AT_M, estimator) for one in drives]
    below = np.array([part[1] for part in parts])
    missed = not_localised_sums(drives)
    sums = [
        SessionSums(np.array([part[0][k] for part in parts]), below) for k in range(len(CURVE_AT_M))
    ]
    bands = [resamples.interval(product(one, missed) if scaled else one) for one in sums]
    return _banded(label, CURVE_AT_M, bands, marks=False)


def row_line(label: str, rows: Sequence[Row], x: Sequence[float], column: str) -> Line:
    """A column of a table in per cent, with the band that the table has for it."""
    bands = [
        Interval(*(row.get(column + end, np.nan) for end in ("", "_low", "_high"))) for row in rows
    ]
    return _banded(label, np.array(x, np.float64), bands)


def _banded(
    label: str, x: NDArray[np.float64], bands: Iterable[Interval], *, marks: bool = True
) -> Line:
    y, low, high = 100 * np.array([(one.estimate, one.low, one.high) for one in bands]).T
    return Line(label, x, y, low, high, marks=marks)
