"""The four pictures of docs/papers.md, from the tables of the studies.

At most four curves each, a logarithmic axis where ratios matter, intervals (90 %) as bars.
`engram_lab.studies.page_pictures` lists them.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray

from engram.viewing.drawings import PALETTE
from engram_lab.intervals import Interval, Resamples, SessionSums

Row = Mapping[str, str]
LANES = {
    "distance": "Γ(distance)",
    "path": "Γ(path), as published",
    "recall": "recall",
    "oracle": "oracle",
}
MEASURES = {"p_gt_10m": "P(> 10 m), %", "share_not_localised": "route missed, %"}
FRONTS = ("as Engram is by default", "100 landmarks, the paper's rules")
# Below, per cent, an axis is linear, down to none.
_LINEAR = 0.1
PARTS = {
    "held out in copy": "everything",
    "held out in budget 1/4": "budget,\n¼ of the bytes",
    "held out in tod": "by hour",
    "held out in tod+paths": "by hour\nand path",
}
MERGED = {"single": "one agent", "4 groups": "four, merged"}
_MARKERS = "os^D"
# Each curve stands so much farther right than the one before.
_ASIDE = 1.025
ARMS = {"A": "Γ(distance)", "B": "recall"}


def read(path: Path) -> list[Row]:
    """The rows of a table."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def usual(rows: Sequence[Row]) -> list[Row]:
    """The rows of one round, T = 10 and the settings' kind of paths, not in real time."""
    asked = {"rounds": "1", "T": "10", "radius": "search", "mode": "memo"}
    some = [one for one in rows if all(one[name] == value for name, value in asked.items())]
    paths = some[0]["paths"] if some else ""  # the settings' own: the first configuration is plain
    return [one for one in some if one["paths"] == paths]


def pooled(rows: Sequence[Row]) -> list[Row]:
    """The rows of all folds but those of the path policies' variants."""
    return usual([one for one in rows if one["fold"] == "all"])


def share_of(rows: Sequence[Row], name: str) -> Interval:
    """A share of the route over sessions, per cent, with its interval."""
    driven_m = np.array([float(one["driven_m"]) for one in rows])
    share = np.array([float(one[name]) for one in rows])
    found = Resamples.of(len(rows)).interval(SessionSums(share * driven_m, driven_m))
    return Interval(100 * found.estimate, 100 * found.low, 100 * found.high)


def sessions_of(rows: Sequence[Row], arm: str, experiment: str, name: str) -> list[Row]:
    """Session rows of one map of the fleet study."""
    wanted = {"arm": arm, "experiment": experiment, "map": name}
    return [one for one in rows if all(one[key] == value for key, value in wanted.items())]


def bars(axes: Axes, at: float, found: Interval, colour: str) -> None:
    """One bar with its interval, and its value above that."""
    axes.bar(at, found.estimate, 0.38, color=colour)
    error = [[found.estimate - found.low], [found.high - found.estimate]]
    axes.errorbar(at, found.estimate, error, color="black", capsize=3)
    axes.annotate(
        f"{found.estimate:.1f}",
        (at, found.high),
        (0, 3),
        textcoords="offset points",
        ha="center",
        fontsize=8,
    )


def curve(
    axes: Axes, rows: Sequence[Row], across: str, measure: str, label: str, *, place: int
) -> None:
    """One curve with its intervals as bars, per cent; set aside by its place, so that none hide."""
    rows = sorted(rows, key=lambda one: float(one[across]))
    x = [_ASIDE ** (place - 1) * float(one[across]) for one in rows]
    y, low, high = (
        np.array([100 * float(one[f"{measure}{end}"]) for one in rows])
        for end in ("", "_low", "_high")
    )
    axes.errorbar(
        x,
        y,
        [y - low, high - y],
        color=PALETTE[place],
        marker=_MARKERS[place],
        markersize=4,
        capsize=2,
        label=label,
    )


def lanes(*fronts: Sequence[Row]) -> Figure:
    """P(> 10 m) and route missed against the number of lanes ([L15] Fig. 11), by front-end."""
    whole = [
        [one for one in pooled(rows) if not one["map_sessions"] and one["lanes"].isdigit()]
        for rows in fronts
    ]
    return _by_front(whole, "lanes", "lanes, Np", (1, 2, 4, 8))


def growth(*fronts: Sequence[Row]) -> Figure:
    """The same as the map grows, two lanes ([L15] Fig. 9)."""
    grown = [
        [one for one in pooled(rows) if one["map_sessions"] and one["lanes"] == "2"]
        for rows in fronts
    ]
    return _by_front(grown, "map_sessions", "drives in the map", (1, 2, 4, 8, 16))


def _by_front(
    fronts: Sequence[Sequence[Row]], across: str, words: str, ticks: Sequence[int]
) -> Figure:
    """A curve for each policy: a row of panels for each measure, a column for each front-end."""
    figure, every = _panels(len(fronts))
    for rows, column in zip(fronts, every.T, strict=True):
        for measure, axes in zip(MEASURES, column, strict=True):
            for place, (policy, label) in enumerate(LANES.items()):
                own = [one for one in rows if one["policy"] == policy]
                curve(axes, own, across, measure, label, place=place)
            _doubling(axes, ticks)
    return _titled(figure, every, words)


def merging(rows: Sequence[Row]) -> Figure:
    """One agent's map against four merged ones ([G16] Fig. 7)."""
    return _compared(rows, "7", MERGED)


def downloads(rows: Sequence[Row]) -> Figure:
    """Held-out drives in downloads for their hour ([G16] Fig. 9); those that have all four."""
    return _compared(rows, "9", PARTS)


def _compared(rows: Sequence[Row], experiment: str, maps: Mapping[str, str]) -> Figure:
    figure, axes = _axes("", "route missed, %")
    for side, (arm, label) in enumerate(ARMS.items()):
        own = {name: sessions_of(rows, arm, experiment, name) for name in maps}
        common = set.intersection(*({one["drive"] for one in each} for each in own.values()))
        for place, name in enumerate(maps):
            found = share_of(
                [one for one in own[name] if one["drive"] in common], "share_not_localised"
            )
            bars(axes, place + 0.4 * side - 0.2, found, PALETTE[side])
        axes.bar(0, 0, color=PALETTE[side], label=label)
    axes.set_xticks(range(len(maps)), maps.values())
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    return figure


def _axes(across: str, up: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(5.6, 3.2), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlabel=across, ylabel=up)
    return figure, axes


def _panels(columns: int) -> tuple[Figure, NDArray[Any]]:
    """A row for each measure, a column for each front-end."""
    figure = Figure(figsize=(7.2, 5.0), layout="constrained")
    every = figure.subplots(len(MEASURES), columns, sharex=True, sharey=True, squeeze=False)
    return figure, every


def _titled(figure: Figure, every: NDArray[Any], across: str) -> Figure:
    """With axes that show both none and all, and what they are."""
    for axes in every.flat:
        axes.set_yscale("symlog", linthresh=_LINEAR)
        axes.set_ylim(-0.015, 130)  # what lies on none is whole
        axes.set_yticks((0, 0.1, 1, 10, 100), ("0", "0.1", "1", "10", "100"))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.grid(axis="y", alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    for axes, front in zip(every[0], FRONTS, strict=False):
        axes.set_title(front, fontsize=10)
    for axes, words in zip(every[:, 0], MEASURES.values(), strict=True):
        axes.set_ylabel(words)
    for axes in every[-1]:
        axes.set_xlabel(across)
    handles, labels = every[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    return figure


def _doubling(axes: Axes, ticks: Sequence[int]) -> None:
    axes.set_xscale("log", base=2)
    axes.set_xticks(ticks, [str(one) for one in ticks])
    axes.xaxis.set_minor_locator(NullLocator())


_BOTH_FRONTS = ("ranking/summary.csv", "starved/summary.csv")
# Each picture by name: its tables, and what draws it from their rows.
DRAWN: Mapping[str, tuple[tuple[str, ...], Callable[..., Figure]]] = {
    "papers_lanes": (_BOTH_FRONTS, lanes),
    "papers_growth": (_BOTH_FRONTS, growth),
    "papers_merge": (("fleet/sessions.csv",), merging),
    "papers_downloads": (("fleet/sessions.csv",), downloads),
}
