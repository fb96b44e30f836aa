"""Curves with confidence bands, side by side: how results are shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.viewing.canvas import save, subplots

Array = NDArray[np.float64]

# Matplotlib's ten and black, then other line styles.
_COLOURS = (*(f"C{number}" for number in range(10)), "black")
_STYLES = ("-", "--", ":")
_PANELS_IN_A_ROW = 4


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """One line of a panel.

    Attributes:
        label: for the legend; equal labels get equal looks in all panels of a picture.
        x, y: (N,) float64.
        low, high: (N,) float64, ends of a confidence band; None for none.
        marks: whether the points are marked.
    """

    label: str
    x: Array
    y: Array
    low: Array | None = None
    high: Array | None = None
    marks: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One set of axes.

    Attributes:
        title, x_label, y_label: words beside it.
        lines: what is drawn.
        x_ticks: places of ticks and what stands there; None for Matplotlib's own.
        least_y: the ordinate is logarithmic from here on; None for a linear one from 0.
    """

    title: str
    x_label: str
    y_label: str
    lines: Sequence[Line]
    x_ticks: Sequence[tuple[float, str]] | None = None
    least_y: float | None = None


@dataclass(slots=True)
class _Looks:
    """Which label looks how."""

    known: dict[str, tuple[str, str]] = field(default_factory=dict)

    def of(self, label: str) -> tuple[str, str]:
        if label not in self.known:
            style, colour = divmod(len(self.known), len(_COLOURS))
            self.known[label] = (_COLOURS[colour], _STYLES[style % len(_STYLES)])
        return self.known[label]


def draw_curves(panels: Sequence[Panel], path: Path, title: str) -> None:
    """Draws panels into an image file, up to four in a row, with one legend.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    rows = -(-len(panels) // _PANELS_IN_A_ROW)
    columns = -(-len(panels) // rows)
    width = max(4.6 * columns, 6.5) + 2.0
    figure, axes = subplots(len(panels), width=width, height=4.2 * rows, rows=rows)
    looks = _Looks()
    handles: dict[str, Any] = {}
    for one, panel in zip(axes, panels, strict=True):
        for line in panel.lines:
            colour, style = looks.of(line.label)
            if line.low is not None and line.high is not None:
                one.fill_between(line.x, line.low, line.high, color=colour, alpha=0.12, linewidth=0)
            (handle,) = one.plot(
                line.x,
                line.y,
                style,
                color=colour,
                marker="o" if line.marks else None,
                markersize=3,
                linewidth=1.3,
            )
            handles.setdefault(line.label, handle)
        if panel.least_y is None:
            one.set_ylim(0, None)
        else:
            one.set_yscale("log", nonpositive="clip")
            one.set_ylim(panel.least_y, None)
            one.yaxis.set_major_formatter("{x:g}")  # 100, 10, 1 rather than powers of ten
        if panel.x_ticks is not None:
            one.set_xticks([at for at, _ in panel.x_ticks], [text for _, text in panel.x_ticks])
        one.set_title(panel.title, fontsize=10)
        one.set_xlabel(panel.x_label)
        one.set_ylabel(panel.y_label)
        one.grid(alpha=0.3)
    figure.legend(list(handles.values()), list(handles), loc="outside right center", fontsize=8)
    figure.suptitle(title, fontsize=11)
    save(figure, path)


def draw_bars(
    values: Sequence[tuple[str, Sequence[tuple[str, float]]]], path: Path, title: str
) -> None:
    """Draws one panel of horizontal bars per quantity into an image file.

    Args:
        values: quantity → its bars, label and length each, first on top.
        path: image file.
        title: over the picture.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
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
