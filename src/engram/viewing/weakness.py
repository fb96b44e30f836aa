"""Weak spots of a map in words and from above: `engram weak-spots`, and the page of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from engram.counts import counted
from engram.graph.model import NodeId, SessionId
from engram.maps.map import Map
from engram.untrusted import printable
from engram.viewing.drawings import (
    BRIDGED,
    GOOD,
    LOST,
    Labels,
    MapAbove,
    Track,
    check_picture,
    draw_parts,
    parts_of,
    save,
)
from engram.viewing.moments import drive_text
from engram.weak_spots import Advice, Spot, WeakSpots

# Colours of a place by the share that drives will probably miss there, over their usual hours.
_CLASSES = (
    (0.02, "up to 2 % missed", GOOD),
    (0.1, "2 to 10 %", BRIDGED),
    (1.0, "above 10 %", LOST),
)
HEAD = ("metres", "along", "hours", "missed", "of all missed", "like drives", "why")
# Spots that people read.
_LISTED = 12
_WIDTHS = (9, 30, 7, 7, 14, 12, 0)


def hours_text(hours: tuple[int, int]) -> str:
    """Hours of day, 0 to 24 all day: 21–3 h."""
    first, end = hours
    return "all day" if end - first >= 24 else f"{first}–{end if end <= 24 else end - 24} h"


def spot_rows(found: WeakSpots, opened: Map) -> list[tuple[str, ...]]:
    """A row of texts for each spot, under `HEAD`."""
    return [_row(one, opened) for one in found.spots]


def _row(spot: Spot, opened: Map) -> tuple[str, ...]:
    place = _drive(spot.session, opened)
    if spot.goal is not None:
        place = f"{spot.goal_m:.0f} m from {printable(spot.goal)}; {place}"
    return (
        f"{spot.from_m:.0f}–{spot.to_m:.0f}",
        place,
        hours_text(spot.hours),
        f"{spot.missed:.0%}",
        f"{spot.expected:.0%}",
        f"{spot.like_drives:.1f}",
        str(spot.why),
    )


def _drive(session: SessionId, opened: Map) -> str:
    return drive_text(opened.sessions[session])


def advice_text(advice: Advice, opened: Map) -> str:
    """The drive that would mend most, in one sentence."""
    return (
        f"Drive this next: {hours_text(advice.hours)}, {advice.from_m:.0f}–{advice.to_m:.0f} m of "
        f"the drive of {_drive(advice.session, opened)}; it mends {advice.mends:.0%} of what is "
        "expected to be missed"
    )


def verdict(found: WeakSpots) -> str:
    """What is expected to be missed, in one sentence."""
    if not found.drives:
        return "no weak spot is known: the map has no drive"
    missed = f"{found.missed:.1%} of the next drive is expected to be missed"
    if not found.spots:
        return f"no weak spot is known; {missed}"
    share = sum(one.expected for one in found.spots)
    return (
        f"{missed}; {share:.0%} of that lies in {counted(len(found.spots), 'weak spot')}, "
        f"{found.named_share:.0%} of {found.route_m:.0f} m and their hours"
    )


def unknown_hours_text(found: WeakSpots) -> str:
    """How many drives have no hour, and what to do; "" if none."""
    if not found.unknown_hours:
        return ""
    drives = counted(found.unknown_hours, "drive")
    return f"{drives} with no known hour, counted at every hour; engram amend sets it"


def weak_spots_text(found: WeakSpots, opened: Map) -> str:
    """A table for people, and what to drive next."""
    rows = spot_rows(found, opened)
    lines = [_line(row) for row in ([HEAD, *rows[:_LISTED]] if rows else [])]
    if len(rows) > _LISTED:
        lines.append(f"and {len(rows) - _LISTED} with less missed: --json lists all")
    lines.append(verdict(found))
    if found.unknown_hours:
        lines.append(unknown_hours_text(found))
    if found.advice is not None:
        lines.append(advice_text(found.advice, opened))
    return "\n".join(lines)


def _line(row: Sequence[str]) -> str:
    return "  ".join(f"{text:{width}s}" for text, width in zip(row, _WIDTHS, strict=True)).rstrip()


def weakness_labels(found: WeakSpots, places: NDArray[np.int64]) -> Labels:
    """What colours nodes: the share of their places that drives will probably miss.

    Args:
        places: (N,) int64, the place of each node; see `places_above`.
    """
    demand_m = found.weakness.demand_m.sum(axis=1)
    missed = found.weakness.expected_m.sum(axis=1) / np.maximum(demand_m, 1e-12)
    kind = np.digitize(np.append(missed, 0.0)[places], [limit for limit, _, _ in _CLASSES[:-1]])
    return Labels(
        tuple(name for _, name, _ in _CLASSES),
        tuple(colour for _, _, colour in _CLASSES),
        kind.astype(np.int64),
    )


def places_above(found: WeakSpots, opened: Map, above: MapAbove) -> NDArray[np.int64]:
    """(N,) int64, the number of the place of each node of a map from above; -1 without one."""
    nodes = [NodeId(UUID(bytes=one.tobytes())) for one in above.placed.uuids]
    return found.places.of_node[np.array([opened.graph.index(one) for one in nodes], np.int64)]


def nodes_along(
    stretch: Spot | Advice, found: WeakSpots, opened: Map, places: NDArray[np.int64]
) -> NDArray[np.int64]:
    """(K,) int64, ascending: nodes at the places of a stretch, whichever drive saved them.

    Args:
        places: (N,) int64, the place of each node; see `places_above`.
    """
    session = opened.graph.session_number(stretch.session)
    assert session is not None  # it is measured along a drive that saved nodes
    inside = found.places.along(session, stretch.from_m, stretch.to_m)
    return np.flatnonzero(np.isin(places, np.flatnonzero(inside)))


def draw_weakness(found: WeakSpots, opened: Map, title: str = "") -> Any:
    """A figure of a map from above, coloured by how much of each place is missed."""
    parts = parts_of(opened, title=title)
    above = parts.above
    labels = weakness_labels(found, places_above(found, opened, above))
    panels = [
        replace(panel, tracks=_tracks(above.points_m, labels, above.part == number))
        for number, panel in enumerate(parts.panels)
    ]
    return draw_parts(panels)


def _tracks(
    points_m: NDArray[np.float64], labels: Labels, chosen: NDArray[np.bool_]
) -> list[Track]:
    """A track for each label that some chosen points, (N,) bool, have."""
    of_label = [chosen & (labels.of_node == number) for number in range(len(labels.names))]
    return [
        Track(name, points_m[which], colour)
        for which, name, colour in zip(of_label, labels.names, labels.colours, strict=True)
        if which.any()
    ]


def plot_weak_spots(found: WeakSpots, opened: Map, out: Path) -> None:
    """Writes the drawing to a file."""
    check_picture(out)
    title = f"{Path(opened.location).name}, revision {opened.revision}, by weakness"
    save(draw_weakness(found, opened, title), out)
