"""Curves with confidence bands or bars, side by side: how results are shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.viewing.drawings import PALETTE, save, subplots

Array = NDArray[np.float64]

# Those that everybody tells apart, two of Matplotlib's and black, then other line styles.
COLOURS = (*PALETTE, "C5", "C7", "black")
_STYLES = ("-", "--", ":")
_LOOKS = tuple((colour, style) for style in _STYLES for colour in COLOURS)
_MARKERS = "os^Dv<>pP*X"
_PANELS_IN_A_ROW = 4
# Points of one abscissa stand beside each other, over this share of the axis at most.
_ASIDE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """One line of a panel.

    Attributes:
        x, y: (N,) float64.
        low, high: (N,) float64, ends of confidence intervals; None for none.
        marks: whether each point counts, and has its interval as a bar; else they make a band.
    """

    label: str
    x: Array
    y: Array
    low: Array | None = None
    high: Array | None = None
    marks: bool = True
    loose_end: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One set of axes.

    Attributes:
        x_ticks: places of ticks and what stands there; None for Matplotlib's own.
        least_y: the ordinate is logarithmic from here on, if anything lies above; None for a linear
            one.
        signed: whether values below 0 are usual; else a linear ordinate begins at 0.
    """

    title: str
    x_label: str
    y_label: str
    lines: Sequence[Line]
    x_ticks: Sequence[tuple[float, str]] | None = None
    least_y: float | None = None
    signed: bool = False


def _looks(
    panels: Sequence[Panel], fixed: Mapping[str, tuple[str, str]]
) -> dict[str, tuple[str, str]]:
    """Colour and style of each label; what has none of its own gets what is left, in turn."""
    labels = list(dict.fromkeys(line.label for panel in panels for line in panel.lines))
    looks = {label: fixed[label] for label in labels if label in fixed}
    free = [look for look in _LOOKS if look not in looks.values()] or list(_LOOKS)
    others = [label for label in labels if label not in looks]
    return looks | {label: free[k % len(free)] for k, label in enumerate(others)}


def draw_curves(
    panels: Sequence[Panel],
    path: Path,
    title: str,
    looks: Mapping[str, tuple[str, str]] = MappingProxyType({}),
) -> None:
    """Draws panels into an image file, up to four in a row, with one legend."""
    rows = -(-len(panels) // _PANELS_IN_A_ROW)
    columns = -(-len(panels) // rows)
    width = max(4.6 * columns, 6.5) + 2.0
    figure, axes = subplots(len(panels), width=width, height=4.2 * rows, rows=rows)
    look_of = _looks(panels, looks)
    handles: dict[str, Any] = {}
    markers = dict(zip(look_of, cycle(_MARKERS), strict=False))
    for one, panel in zip(axes, panels, strict=True):
        for line, aside in zip(panel.lines, _asides(panel.lines), strict=True):
            if not line.marks:
                _draw_band(one, line, look_of[line.label][0], min(0.08, 0.4 / len(panel.lines)))
            handle = _draw_line(one, line, *look_of[line.label], markers[line.label], aside)
            handles.setdefault(line.label, handle)
        _draw_axes(one, panel)
    figure.legend(list(handles.values()), list(handles), loc="outside right center", fontsize=8)
    figure.suptitle(title, fontsize=11)
    save(figure, path)


def _asides(lines: Sequence[Line]) -> Array:
    """(N,) float64: how far the points of each line stand aside, so that none hide."""
    marked = np.array([line.marks for line in lines])
    span = np.ptp(np.concatenate([line.x for line in lines]))
    places = np.cumsum(marked) - (marked.sum() + 1) / 2
    step = min(_ASIDE / max(marked.sum() - 1, 1), 0.012) * span
    return np.asarray(np.where(marked, step * places, 0.0))


def _draw_band(axes: Any, line: Line, colour: str, opacity: float) -> None:
    if line.low is not None and line.high is not None:
        axes.fill_between(line.x, line.low, line.high, color=colour, alpha=opacity, linewidth=0)
        for edge in (line.low, line.high):  # bands of many lines hide each other, edges do not
            axes.plot(line.x, edge, color=colour, alpha=0.25, linewidth=0.5)


def _draw_line(axes: Any, line: Line, colour: str, style: str, marker: str, aside: float) -> Any:
    """Returns what the legend shows."""
    x = line.x + aside
    if line.marks and line.low is not None and line.high is not None:
        axes.vlines(x, line.low, line.high, color=colour, alpha=0.6, linewidth=1)
    end = len(x) - 1 if line.loose_end else len(x)
    drawn = {"color": colour, "markersize": 4, "linewidth": 1.3}
    drawn["marker"] = marker if line.marks else None
    (handle,) = axes.plot(x[:end], line.y[:end], style, **drawn)
    if line.loose_end:
        axes.plot(x[-2:], line.y[-2:], ":", **drawn)
    return handle


def _draw_axes(axes: Any, panel: Panel) -> None:
    if panel.least_y is not None and any((line.y > panel.least_y).any() for line in panel.lines):
        axes.set_yscale("log", nonpositive="clip")
        axes.set_ylim(panel.least_y, None)
        axes.yaxis.set_major_formatter("{x:g}")  # 100, 10, 1 rather than powers of ten
    elif panel.signed:
        axes.axhline(0.0, color="grey", linewidth=0.8)
    else:
        highest = max((float(line.y.max(initial=0)) for line in panel.lines), default=0)
        axes.set_ylim(0, None if highest > 0 else 1)
    if panel.x_ticks is not None:
        axes.set_xticks([at for at, _ in panel.x_ticks], [text for _, text in panel.x_ticks])
    axes.set_title(panel.title, fontsize=10)
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    axes.grid(alpha=0.3)


def draw_bars(
    values: Sequence[tuple[str, Sequence[tuple[str, float]]]], path: Path, title: str
) -> None:
    """Draws one panel of horizontal bars per quantity into an image file."""
    longest = max((len(bars) for _, bars in values), default=1)
    figure, axes = subplots(len(values), width=4.0 * len(values), height=1.2 + 0.24 * longest)
    for one, (quantity, bars) in zip(axes, values, strict=True):
        labels, lengths = [label for label, _ in bars], [length for _, length in bars]
        places = np.arange(len(bars))
        one.barh(places, lengths, color="C0", height=0.7)
        for place, length in zip(places, lengths, strict=True):
            one.annotate(f" {length:.3g}", (length, place), va="center", fontsize=7)
        one.set_yticks(places, labels, fontsize=8)
        one.invert_yaxis()
        one.margins(x=0.15)
        one.set_xlim(0, None if max(lengths, default=0) > 0 else 1)
        one.set_title(quantity, fontsize=9)
    figure.suptitle(title, fontsize=11)
    save(figure, path)
