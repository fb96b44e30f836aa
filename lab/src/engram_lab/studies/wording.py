"""How results are worded in Markdown: tables, shares and ratios with their intervals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np

from engram_lab.intervals import Interval, Resamples, SessionSums, difference

# What a page of claims sets side by side: what, paper, must, aim, measured.
Row: TypeAlias = tuple[str, str, str, str, str]
CLAIM_COLUMNS: Row = ("what", "paper", "must", "aim", "measured")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table."""
    return [
        "| " + " | ".join(head) + " |",
        "| " + " | ".join("---" for _ in head) + " |",
        *("| " + " | ".join(row) + " |" for row in rows),
    ]


def share(value: float) -> str:
    """A share."""
    return f"{100 * value:.2f} %"


def percent(interval: Interval) -> str:
    """A share and its interval."""
    if np.isnan(interval.estimate):
        return "–"
    low, high = 100 * interval.low, 100 * interval.high
    return f"{100 * interval.estimate:.2f} % ({low:.2f} … {high:.2f})"


def times(interval: Interval) -> str:
    """A ratio and its interval."""
    if np.isnan(interval.estimate):
        return "– (0 ÷ 0)"
    return f"{_number(interval.estimate)}× ({_number(interval.low)} … {_number(interval.high)})"


def against(resamples: Resamples, a: SessionSums, b: SessionSums) -> str:
    """Two shares and their paired difference with its interval."""
    gap = resamples.interval(difference(a, b))
    low, high = _signed(100 * gap.low), _signed(100 * gap.high)
    points = f"{_signed(100 * gap.estimate)} ({low} … {high}) points"
    return f"{share(a.value)} against {share(b.value)}, difference {points}"


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "\N{MINUS SIGN}")


def _number(value: float) -> str:
    return "∞" if np.isinf(value) else f"{value:.2f}"
