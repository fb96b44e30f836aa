"""Drawings of maps from above and of drives over their distance, by Matplotlib.

A drawing is one `Figure`. `save` writes it to a file, `as_svg` makes it part of a page, whose
colours for text and background it takes.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram.counts import counted
from engram.errors import InputError, extra
from engram.files import check_output
from engram.graph.clock import hour_of_day
from engram.graph.graph import grouped
from engram.graph.model import Anchor, NodeId
from engram.graph.placing import held_by_anchors
from engram.maps.difference import MapDifference
from engram.maps.map import Map
from engram.maps.placed import PlacedNodes
from engram.untrusted import printable
from engram.viewing.moments import drive_text

# Colours that people with any colour vision tell apart. Source: Okabe and Ito, 2008.
PALETTE = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#8c6bb1", "#7f7f00",
)  # fmt: skip
GOOD, BRIDGED, LOST = "#009e73", "#e69f00", "#d55e00"
_FEW = "#999999"
# What stands in a drawing for a page's colours of text, of lesser text and of its background.
_INK, _MUTED, _PAPER = "#010203", "#040506", "#fcfdfe"
# Among more points Matplotlib looks for the best place of a legend for a second.
_MOST_SEARCHED = 100_000
# A legend longer than this hides the map.
_NAMED = 12
# So many parts of a map are drawn; the others are counted.
_PARTS = 6
# Arrows along a track: so many over the width of the drawing.
_ARROWS = 10
# Points nearer to each other than this share of the drawing's width are one dot.
_DOTS = 2000
_WIDTH_IN = 9.0


def matplotlib_for_files() -> ModuleType:
    """Matplotlib without a window."""
    with extra("plots", "pictures need Matplotlib"):
        import matplotlib
        import matplotlib.figure
    matplotlib.use("Agg")
    return matplotlib


def subplots(count: int, *, width: float, height: float, rows: int = 1) -> tuple[Any, list[Any]]:
    """A figure with `count` axes in `rows` rows, of which the last may be shorter.

    Width and height are those of the figure, in inches.
    """
    matplotlib_for_files()
    from matplotlib import pyplot

    columns = -(-count // rows)
    figure, axes = pyplot.subplots(
        rows, columns, figsize=(width, height), layout="constrained", squeeze=False
    )
    every = list(np.ravel(axes))
    for unused in every[count:]:
        unused.remove()
    return figure, every[:count]


def save(figure: Any, path: Path) -> None:
    """Writes the figure and releases its memory."""
    from matplotlib import pyplot

    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:  # no such folder; an unknown file extension
        raise InputError(f"the picture {path} cannot be written: {error}") from error
    finally:
        pyplot.close(figure)


def as_svg(figure: Any, about: str) -> str:
    """The figure as part of an HTML page, in the page's colours; releases its memory.

    Args:
        about: what it shows, for those who do not see it.
    """
    matplotlib = matplotlib_for_files()
    from matplotlib import pyplot

    for axes in figure.axes:
        _in_page_colours(axes)
    written = io.StringIO()
    try:
        with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": about}):
            figure.savefig(written, format="svg", transparent=True, metadata={"Date": None})
    finally:
        pyplot.close(figure)
    text = written.getvalue()
    drawn = text[text.index("<svg") :]
    drawn = re.sub(r"<metadata>.*?</metadata>", "", drawn, count=1, flags=re.DOTALL)
    drawn = re.sub(r' (?:width|height)="[\d.]+pt"', "", drawn, count=2)
    for stand_in, colour in ((_INK, "ink"), (_MUTED, "muted"), (_PAPER, "paper")):
        drawn = drawn.replace(stand_in, f"var(--{colour})")
    return drawn.replace("<svg ", f'<svg role="img" aria-label="{escape(printable(about))}" ', 1)


def _in_page_colours(axes: Any) -> None:
    axes.tick_params(colors=_MUTED)
    for text in (axes.title, axes.xaxis.label, axes.yaxis.label):
        text.set_color(_INK)
    for spine in axes.spines.values():
        spine.set_color(_MUTED)
    legend = axes.get_legend()
    if legend is not None:
        legend.get_frame().set(facecolor=_PAPER, edgecolor=_MUTED)
        for text in legend.get_texts():
            text.set_color(_INK)


def check_picture(path: Path) -> None:
    """Checks before the work whether a picture can be written to a path."""
    check_output(path)
    formats = matplotlib_for_files().figure.Figure().canvas.get_supported_filetypes()
    ending = path.suffix.removeprefix(".").lower()
    if ending not in formats:  # Matplotlib would write another file, NAME.png
        raise InputError(
            f"the picture {path} cannot be written: .{ending} is not one of {', '.join(formats)}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Points of one colour in a drawing.

    Attributes:
        points_m: (N, 2) float64, x and y in the map frame, metres.
        colour: Matplotlib colour; None for the next of a series.
        chain: (N,) int64; points of one number are joined by a line, in their order, with arrows
            in that direction. None: none are.
        starts: (N,) bool, the points where drives start; None for none.
        mark: Matplotlib marker of the points.
    """

    label: str
    points_m: NDArray[np.float64]
    colour: str | None = None
    chain: NDArray[np.int64] | None = None
    starts: NDArray[np.bool_] | None = None
    mark: str = "."

    def lines(self) -> list[NDArray[np.float64]]:
        """The (K, 2) points of each line, metres in the map frame, K >= 2."""
        if self.chain is None:
            return []
        return [self.points_m[rows] for rows in grouped(self.chain) if len(rows) > 1]


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """Tracks that share one frame, with places named in it, x and y in metres."""

    title: str
    tracks: Sequence[Track]
    marks: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def draw_from_above(panels: Sequence[Panel]) -> Any:
    """A figure of panels side by side; a label has the same colour in all of them."""
    figure, every = subplots(len(panels), width=7 * len(panels), height=6)
    _fill(every, panels)
    return figure


def draw_parts(panels: Sequence[Panel]) -> Any:
    """A figure of a map: the first part large, below it the others, each to its own scale."""
    matplotlib_for_files()
    from matplotlib import pyplot

    first, *others = panels
    height_in = min(max(_WIDTH_IN * _slimness(first), 2.6), 6.5) + 0.8
    if not others:
        figure, every = subplots(1, width=_WIDTH_IN, height=height_in)
    else:
        figure = pyplot.figure(figsize=(_WIDTH_IN, height_in + 2.6), layout="constrained")
        grid = figure.add_gridspec(2, len(others), height_ratios=[height_in, 2.6])
        every = [figure.add_subplot(grid[0, :])]
        every += [figure.add_subplot(grid[1, column]) for column in range(len(others))]
    _fill(every, panels)
    return figure


def _slimness(panel: Panel) -> float:
    """Height of what is drawn, as a share of its width."""
    points = np.concatenate([track.points_m for track in panel.tracks] or [np.zeros((1, 2))])
    width_m, height_m = np.ptp(points, axis=0) if len(points) else (1.0, 1.0)
    return float(max(height_m, 1.0) / max(width_m, 1.0))


def _fill(every: Sequence[Any], panels: Sequence[Panel]) -> None:
    names = dict.fromkeys(_series(track) for panel in panels for track in panel.tracks)
    colours = {name: PALETTE[number % len(PALETTE)] for number, name in enumerate(names)}
    for number, (axes, panel) in enumerate(zip(every, panels, strict=True)):
        for track in panel.tracks:
            _draw_track(axes, track, track.colour or colours[_series(track)])
        for name, place in panel.marks.items():
            axes.plot(*place, "*", color=_INK, markersize=9)
            axes.annotate(
                _shown(name), place, xytext=(5, 5), textcoords="offset points", fontsize=8,
                color=_INK,
            )  # fmt: skip
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.06)
        axes.set_xlabel("x, m", fontsize=9)
        if number == 0:
            axes.set_ylabel("y, m", fontsize=9)
        axes.tick_params(labelsize=8)
        axes.set_title(_shown(panel.title), fontsize=10)
        if panel.tracks and (number == 0 or len(panels) == 2):
            _add_legend(axes, panel)


def _add_legend(axes: Any, panel: Panel) -> None:
    if any(track.starts is not None and track.starts.any() for track in panel.tracks):
        axes.plot([], [], "o", color=_MUTED, markerfacecolor=_PAPER, label="first node of a drive")
    points = sum(len(track.points_m) for track in panel.tracks)
    loc = "best" if points <= _MOST_SEARCHED else "upper right"
    axes.legend(fontsize=8, loc=loc, framealpha=0.9)


def _draw_track(axes: Any, track: Track, colour: str) -> None:
    lines = track.lines()
    x, y = track.points_m[:, 0], track.points_m[:, 1]
    extent_m = float(np.ptp(track.points_m, axis=0).max(initial=0.0))
    seen = _one_of_each(_cells(track.points_m, extent_m / _DOTS))
    axes.plot(x[seen], y[seen], track.mark, color=colour, markersize=3 if lines else 5)
    if track.label:
        axes.plot([], [], "-" if lines else track.mark, color=colour, label=_shown(track.label))
    if lines:  # one artist for all of them, with gaps between
        gap = np.full((1, 2), np.nan)
        drawn = np.concatenate([part for line in lines for part in (line, gap)])
        axes.plot(drawn[:, 0], drawn[:, 1], "-", color=colour, linewidth=1.4, alpha=0.8)
    for place, heading_rad in _arrows(lines, max(extent_m / _ARROWS, 1.0)):
        marker = (3, 0, float(np.rad2deg(heading_rad)) - 90.0)
        axes.plot(*place, marker=marker, color=colour, markersize=7, linestyle="none")
    if track.starts is not None and track.starts.any():
        axes.plot(
            x[track.starts], y[track.starts], "o", color=colour, markerfacecolor=_PAPER,
            markersize=8, markeredgewidth=1.8,
        )  # fmt: skip


def _arrows(
    lines: Sequence[NDArray[np.float64]], spacing_m: float
) -> list[tuple[NDArray[np.float64], float]]:
    """Places, (2,) metres in the map frame, and headings, radians, of arrows along lines.

    Where many lines run the same way there is one arrow for all of them.
    """
    found = []
    for line in lines:
        steps = np.diff(line, axis=0)
        driven_m = np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))
        for at_m in np.arange(spacing_m / 2, driven_m[-1], spacing_m):
            at = int(np.searchsorted(driven_m, at_m))
            heading_rad = float(np.arctan2(steps[at, 1], steps[at, 0]))
            found.append(((line[at] + line[at + 1]) / 2, heading_rad))
    if not found:
        return []
    places, headings = (np.array(each) for each in zip(*found, strict=True))
    quarter = np.rint(headings / (np.pi / 2)).astype(np.int64) % 4
    return [found[at] for at in _one_of_each(4 * _cells(places, spacing_m / 2) + quarter)]


def _cells(points_m: NDArray[np.float64], size_m: float) -> NDArray[np.int64]:
    """Numbers of the squares of a size, at most 2¹⁶ side by side, in which N points are; (N,)."""
    if size_m == 0.0:
        return np.zeros(len(points_m), np.int64)
    squares: NDArray[np.int64] = np.floor(points_m / size_m).astype(np.int64)
    return 2**16 * squares[:, 0] + squares[:, 1]


def _one_of_each(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each of the (N,) keys is first, in that order."""
    return np.sort(np.unique(keys, return_index=True)[1])


def _shown(text: str) -> str:
    """A text of a stranger's map: without control characters and Matplotlib's formulas."""
    shown = printable(text).replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown  # Matplotlib would leave it out


def _series(track: Track) -> str:
    return track.label.split(" (")[0]


# Distinct names, and the (N,) int64 name of each node.
_Named: TypeAlias = tuple[list[str], NDArray[np.int64]]


def _named(names: Sequence[str], of_node: NDArray[np.int64]) -> _Named:
    """What N nodes are called by the (N,) numbers of names, of which some may be equal."""
    distinct = sorted(set(names))
    number = {name: at for at, name in enumerate(distinct)}
    return distinct, np.array([number[name] for name in names], np.int64)[of_node]


def _experiences(placed: PlacedNodes) -> _Named:
    return _named([drive_text(session) for session in placed.sessions], placed.session)


def _hours(placed: PlacedNodes) -> _Named:
    # Within a second the hour of a drive is looked up once.
    seconds = np.stack([placed.session, placed.stamp_ns // 1_000_000_000], axis=1)
    times, which = np.unique(seconds, axis=0, return_inverse=True)
    names = []
    for session, second in times.tolist():
        hour = hour_of_day(placed.sessions[session], second * 1_000_000_000)
        names.append("hour unknown" if hour is None else f"{int(hour):02d} h")
    return _named(names, which.ravel())


def _revisions(placed: PlacedNodes) -> _Named:
    numbers, which = np.unique(placed.revision, return_inverse=True)
    return _named([f"revision {number:3d}" for number in numbers.tolist()], which)


def _robots(placed: PlacedNodes) -> _Named:
    return _named([session.robot for session in placed.sessions], placed.session)


COLOURS: Mapping[str, Callable[[PlacedNodes], _Named]] = {
    "experience": _experiences,
    "hour": _hours,
    "revision": _revisions,
    "robot": _robots,
}


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """What the N nodes of a map are coloured by: L labels, each with its colour.

    Attributes:
        names: of the most frequent labels, by name; last the others together, if there are more.
        colours: of each label, as CSS and Matplotlib write them.
        of_node: (N,) int64, the label of each node.
    """

    names: tuple[str, ...]
    colours: tuple[str, ...]
    of_node: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class MapAbove:
    """What pictures and pages show of a map from above: its N placed nodes, part by part.

    Attributes:
        placed: the nodes.
        points_m: (N, 2) float64, x and y in the map frame, metres.
        part: (N,) int64, number of the part of each node, 0 the largest. How two parts lie to each
            other is unknown: neither edges nor anchors determine it.
        starts: (N,) bool, the first node of each drive.
        goals: part and x and y in the map frame, metres, by name.
    """

    placed: PlacedNodes
    points_m: NDArray[np.float64]
    part: NDArray[np.int64]
    starts: NDArray[np.bool_]
    goals: Mapping[str, tuple[int, float, float]]

    def sizes(self) -> list[int]:
        """Number of nodes of each part."""
        return [int(count) for count in np.bincount(self.part)]

    def pieces(self) -> list[int]:
        """Number of unconnected pieces of each part; where more than one, anchors hold them."""
        both = np.unique(np.stack([self.part, self.placed.component], axis=1), axis=0)
        return [int(count) for count in np.bincount(both[:, 0])]

    def labels(self, by: str) -> Labels:
        """What colours the nodes, by a key of `COLOURS`."""
        names, called = COLOURS[by](self.placed)
        counts = np.bincount(called, minlength=len(names))
        # Names that no node has come last, and are not named.
        frequent = np.argsort(-counts, kind="stable")[: min(_NAMED, np.count_nonzero(counts))]
        kept = np.sort(frequent)
        largest = [names[at] for at in kept.tolist()]
        number_of = np.full(len(names), len(largest), np.int64)
        number_of[kept] = np.arange(len(largest))
        of_node = number_of[called]
        colours = [PALETTE[number % len(PALETTE)] for number in range(len(largest))]
        if (others := np.count_nonzero(counts) - len(largest)) > 0:
            largest.append(f"{others} more")
            colours.append(_FEW)
        return Labels(tuple(largest), tuple(colours), of_node)


def map_above(opened: Map) -> MapAbove:
    """A map from above, as of its revision."""
    placed = opened.placed()
    named = [goal.node for goal in opened.goals.values()]
    named += [anchor.node for anchor in opened.anchors]
    row_of = _rows_of(placed, named)
    part = _by_size(_in_one_frame(placed.component, row_of, opened.anchors))
    goals = {}
    for name, goal in sorted(opened.goals.items()):
        place = opened.frame.locate(goal)
        goals[name] = int(part[row_of[goal.node.bytes]]), place.x_m, place.y_m
    return MapAbove(placed, placed.positions[:, :2], part, _starts(placed), goals)


def _rows_of(placed: PlacedNodes, wanted: Sequence[NodeId]) -> dict[bytes, int]:
    """The rows of some nodes, as far as they are placed."""
    if not wanted:
        return {}
    ids = {node.bytes for node in wanted}
    first = np.ascontiguousarray(placed.uuids).view(np.uint64).reshape(-1, 2)[:, 0]
    likely = np.isin(first, np.frombuffer(b"".join(ids), np.uint64)[::2])
    found = ((placed.uuids[row].tobytes(), row) for row in np.flatnonzero(likely).tolist())
    return {uuid: row for uuid, row in found if uuid in ids}


def _in_one_frame(
    component: NDArray[np.int64], row_of: Mapping[bytes, int], anchors: Sequence[Anchor]
) -> NDArray[np.int64]:
    """(N,) int64 components, those that anchors hold in the map frame as one."""
    known = [one for one in anchors if one.node.bytes in row_of]
    at = np.array([row_of[one.node.bytes] for one in known], np.int64)
    positions_m = np.array([(one.x_m, one.y_m) for one in known]).reshape(-1, 2)
    held = held_by_anchors(component[at], positions_m)
    return np.where(np.isin(component, held), held.min(initial=len(component)), component)


@dataclass(frozen=True, slots=True, eq=False)
class MapParts:
    """A drawing of a map from above, a panel for each of its largest parts.

    Attributes:
        above: the map.
        panels: the largest parts, one panel each.
        colours: of the labels, by name.
    """

    above: MapAbove
    panels: list[Panel]
    colours: Mapping[str, str] = field(default_factory=dict)

    @property
    def nodes(self) -> int:
        """Of all parts."""
        return len(self.above.part)

    def text(self) -> str:
        """What the drawing leaves out; "" if nothing."""
        left_out = self.above.sizes()[_PARTS:]
        if not left_out:
            return ""
        return (
            f"{counted(len(left_out), 'smaller part')} ({counted(sum(left_out), 'node')}) not drawn"
        )

    def caption(self, colours: str) -> str:
        """What lies below the drawing: its colours, and what parts are, if there are several."""
        words = f"{colours}; arrows: their direction; rings: their first nodes."
        if len(self.above.sizes()) > 1:
            words += (
                " A part is what matches and odometry connect. How two parts lie to each other is "
                "unknown until a drive leads from one to the other."
            )
        return f"{words} {text}." if (text := self.text()) else words


def parts_of(opened: Map, by: str = "experience", title: str = "") -> MapParts:
    """What is drawn of a map.

    Args:
        by: key of `COLOURS`.
        title: of the drawing.
    """
    above = map_above(opened)
    labels, sizes = above.labels(by), above.sizes()
    panels = [
        Panel(
            _part_title(title, number, len(sizes), size),
            _tracks(above, labels, above.part == number),
            {name: (x, y) for name, (part, x, y) in above.goals.items() if part == number},
        )
        for number, size in enumerate(sizes[:_PARTS])
    ]
    colours = dict(zip(labels.names, labels.colours, strict=True))
    return MapParts(above, panels or [Panel(title, [])], colours)


def _tracks(above: MapAbove, labels: Labels, chosen: NDArray[np.bool_]) -> list[Track]:
    """The chosen points, (N,) bool, a track for each label."""
    tracks = []
    for number, (name, colour) in enumerate(zip(labels.names, labels.colours, strict=True)):
        which = chosen & (labels.of_node == number)
        if count := int(which.sum()):
            chains = above.placed.experience[which]
            label = f"{name} ({counted(count, 'node')})"
            starts = None if colour == _FEW else above.starts[which]
            tracks.append(Track(label, above.points_m[which], colour, chains, starts))
    return tracks


def _by_size(components: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) int64 numbers of (N,) components, the largest 0."""
    _, which, counts = np.unique(components, return_inverse=True, return_counts=True)
    rank = np.empty(len(counts), np.int64)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(counts))
    return np.asarray(rank[which.ravel()], np.int64)


def _starts(placed: PlacedNodes) -> NDArray[np.bool_]:
    """(N,) bool: the first node of each drive."""
    starts = np.zeros(len(placed), np.bool_)
    order = np.lexsort((placed.stamp_ns, placed.session))
    _, first = np.unique(placed.session[order], return_index=True)
    starts[order[first]] = True
    return starts


def _part_title(title: str, number: int, count: int, nodes: int) -> str:
    if count <= 1:
        return title
    size = counted(nodes, "node")
    if number == 0:
        return f"{title}: part 1 of {count}, {size}"
    return f"part {number + 1}: {size}\nnot joined yet"


def plot_map(
    path: Path, out: Path, by: str = "experience", at: int | str | None = None
) -> MapParts:
    """Draws a map and its goals from above, in the map frame; returns what was drawn.

    Relative positions are accurate locally; over long distances they drift with odometry, where no
    anchors hold them.

    Args:
        by: key of `COLOURS`.
        at: number or tag of the revision; None for the newest.
    """
    check_picture(out)
    with Map.open(path, at=at) as opened:
        parts = parts_of(opened, by, f"{path.name}, revision {opened.revision}, by {by}")
        save(draw_parts(parts.panels), out)
        return parts


def draw_difference(map_path: Path, difference: MapDifference, path: Path) -> None:
    """Draws the unchanged, added and removed parts between two revisions, in the map frame."""
    drawn = []
    for revision, changed in (
        (difference.after, difference.added),
        (difference.before, difference.removed),
    ):
        with Map.open(map_path, at=revision) as opened:
            placed = opened.placed()
            points, ids = placed.positions[:, :2], {node.bytes for node in changed}
            mask = np.array([uuid.tobytes() in ids for uuid in placed.uuids], bool)
        drawn += [points[~mask], points[mask]]
    kept, added, _, removed = drawn
    tracks = [
        Track(f"{label}: {counted(len(points), 'node')}", points, colour)
        for label, points, colour in (
            ("in both", kept, "0.6"),
            ("added", added, GOOD),
            ("removed", removed, LOST),
        )
        if len(points)
    ]
    title = f"Revision {difference.before} → {difference.after}"
    save(draw_from_above([Panel(title, tracks)]), path)


# What stands for frames that no node matched, in strips and on maps.
BY_ODOMETRY, NOWHERE, UNMEASURED = "by odometry alone", "lost", "without odometry"
# Hatching and marks, no colours: those are the experiences'.
_HATCHES = {BY_ODOMETRY: "", NOWHERE: "////", UNMEASURED: "xxxx"}
# Stretches without a match that a strip writes the length of, metres.
_LONG_GAP_M = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """What a robot made of a drive's F frames.

    Attributes:
        at_m: (F,) float64, distance driven at each frame, metres, not decreasing.
        names: of each frame the drive whose node it matched, or one of `BY_ODOMETRY`, `NOWHERE`,
            `UNMEASURED`.
        confidence: (F,) float64, log-odds, NaN where unknown.
        localised: (F,) bool.
        places_m: (F, 2) float64, x and y in the map frame, metres; NaN where unknown.
    """

    at_m: NDArray[np.float64]
    names: Sequence[str]
    confidence: NDArray[np.float64]
    localised: NDArray[np.bool_]
    places_m: NDArray[np.float64]

    def runs(self) -> list[tuple[str, int, int]]:
        """Runs of frames of one name: the name, the first and the last frame."""
        ends = [at for at in range(1, len(self.names)) if self.names[at] != self.names[at - 1]]
        bounds = [0, *ends, len(self.names)]
        return [(self.names[a], a, b - 1) for a, b in pairwise(bounds) if b > a]

    def gaps(self) -> list[tuple[float, float]]:
        """Stretches between matches, from and to, metres, the drive's start and end included."""
        matched_m = self.at_m[self.localised]
        marks = [0.0, *matched_m.tolist(), float(self.at_m[-1])] if len(self.at_m) else []
        return [(a, b) for a, b in pairwise(marks) if b > a]


def draw_strip(course: Course, known: Mapping[str, str] | None = None) -> Any:
    """A drive over its distance: which drive's nodes it matched, and how surely.

    Args:
        known: colours of a map's drives, by name; not used where two of the drives share one.
    """
    figure, (band, sure) = subplots(2, width=_WIDTH_IN, height=3.6, rows=2)
    names = sorted(set(course.names) - _HATCHES.keys())
    colours = {name: PALETTE[number % len(PALETTE)] for number, name in enumerate(names)}
    as_known = {name: colour for name, colour in (known or {}).items() if name in colours}
    if len(set(as_known.values())) == len(names):
        colours = as_known
    for name, first, last in course.runs():
        start_m = float(course.at_m[first - 1]) if first else 0.0
        width_m = max(float(course.at_m[last]) - start_m, 1e-3)
        band.broken_barh([(start_m, width_m)], (0, 1), **_filling(name, colours))
    for start_m, end_m in course.gaps():
        if end_m - start_m >= _LONG_GAP_M:
            band.text(
                (start_m + end_m) / 2, 0.5, f"{end_m - start_m:.0f} m", ha="center", va="center",
                fontsize=8, color=_INK, bbox={"facecolor": _PAPER, "edgecolor": "none", "pad": 2},
            )  # fmt: skip
    band.set_yticks([])
    band.set_title("Whose nodes each frame matched", fontsize=10)
    # The legend has the experiences first.
    for name in [*names, *(one for one in _HATCHES if one in course.names)]:
        band.broken_barh([], (0, 1), label=_shown(name), **_filling(name, colours))
    _legend_below(band)
    for name, colour in colours.items():
        chosen = course.localised & np.array([one == name for one in course.names], bool)
        sure.plot(course.at_m[chosen], course.confidence[chosen], ".", color=colour, markersize=4)
    refused = ~course.localised & np.isfinite(course.confidence)
    if refused.any():
        sure.plot([], [], ".", color=_INK, markersize=4, label="matched")
        sure.plot(
            course.at_m[refused], course.confidence[refused], "x", color=_INK, markersize=4,
            label="refused",
        )  # fmt: skip
        sure.legend(
            fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.2
        )
    sure.set_title("Confidence of the best attempt", fontsize=10)
    sure.set_xlabel("distance driven, m", fontsize=9)
    end_m = float(course.at_m[-1]) if len(course.at_m) else 1.0
    for axes in (band, sure):
        axes.set_xlim(0.0, max(end_m, 1e-3))
        axes.tick_params(labelsize=8)
    return figure


def _filling(name: str, colours: Mapping[str, str]) -> dict[str, Any]:
    """How a strip fills the frames of one name."""
    if name in colours:
        return {"color": colours[name]}
    if not _HATCHES[name]:
        return {"color": "0.75"}
    return {"facecolor": "none", "edgecolor": _MUTED, "hatch": _HATCHES[name]}


def _legend_below(axes: Any) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        columns = min(len(labels), 3)
        axes.legend(
            handles, labels, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.2),
            ncols=columns,
        )  # fmt: skip


def draw_course(parts: MapParts, course: Course) -> Any:
    """A map from above, and over it where a drive was localised."""
    from scipy.spatial import cKDTree  # verbs that draw nothing import this module, too

    known = np.asarray(np.isfinite(course.places_m).all(axis=1), bool)
    of = np.full(len(known), -1, np.int64)
    if parts.nodes and known.any():
        _, nearest = cKDTree(parts.above.points_m).query(course.places_m[known])
        of[known] = parts.above.part[nearest]
    panels = []
    for number, panel in enumerate(parts.panels):
        driven = [
            Track(label, course.places_m[chosen], _INK, mark=mark)
            for label, mark, which in (
                ("localised", ".", course.localised),
                ("not localised", "x", ~course.localised),
            )
            if np.any(chosen := np.asarray(which & (of == number), bool))
        ]
        panels.append(replace(panel, tracks=[*panel.tracks, *driven]))
    return draw_parts(panels)
