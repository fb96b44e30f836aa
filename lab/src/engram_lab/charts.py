"""Curves with confidence bands, side by side: how results are shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.viewing.drawings import save, subplots

Array = NDArray[np.float64]

# Matplotlib's ten and black, then other line styles.
_COLOURS = (*(f"C{number}" for number in range(10)), "black")
_STYLES = ("-", "--", ":")
_LOOKS = tuple((colour, style) for style in _STYLES for colour in _COLOURS)
_PANELS_IN_A_ROW = 4


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """One line of a panel.

    Attributes:
        x, y: (N,) float64.
        low, high: (N,) float64, ends of a confidence band; None for none.
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
    for one, panel in zip(axes, panels, strict=True):
        for line in panel.lines:
            handle = _draw_line(one, line, *look_of[line.label], min(0.08, 0.4 / len(panel.lines)))
            handles.setdefault(line.label, handle)
        _draw_axes(one, panel)
    figure.legend(list(handles.values()), list(handles), loc="outside right center", fontsize=8)
    figure.suptitle(title, fontsize=11)
    save(figure, path)


def _draw_line(axes: Any, line: Line, colour: str, style: str, band: float) -> Any:
    """With its band, as opaque as given; returns what the legend shows."""
    if line.low is not None and line.high is not None:
        axes.fill_between(line.x, line.low, line.high, color=colour, alpha=band, linewidth=0)
        for edge in (line.low, line.high):  # bands of many lines hide each other, edges do not
            axes.plot(line.x, edge, color=colour, alpha=0.25, linewidth=0.5)
    marker = "o" if line.marks else None
    end = len(line.x) - 1 if line.loose_end else len(line.x)
    drawn = {"color": colour, "marker": marker, "markersize": 3, "linewidth": 1.3}
    (handle,) = axes.plot(line.x[:end], line.y[:end], style, **drawn)
    if line.loose_end:
        axes.plot(line.x[-2:], line.y[-2:], ":", **drawn)
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
