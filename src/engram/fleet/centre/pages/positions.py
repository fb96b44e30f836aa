"""What the page of a map shows: its nodes from above, its weak spots, pictures, what changed."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np

from engram.counts import counted
from engram.maps.difference import MapDifference, Region
from engram.maps.map import Map
from engram.untrusted import printable
from engram.viewing.drawings import COLOURS, Labels, map_above
from engram.viewing.moments import drive_text
from engram.viewing.weakness import (
    HEAD,
    advice_text,
    nodes_along,
    places_above,
    spot_rows,
    unknown_hours_text,
    verdict,
    weakness_labels,
)
from engram.weak_spots import find_weak_spots

_KEPT = 8
# Of nodes that a revision added.
_PICTURES = 4
# Weak spots that people read.
_SPOTS = 40


@lru_cache(maxsize=_KEPT)
def drawn(path: Path, version: str, revision: int) -> bytes:
    """A revision from above as JSON, a list for each column of its nodes; kept by version."""
    del version  # names the revision permanently; after a restore the number alone does not
    with Map.open(path, at=revision) as store:
        above = map_above(store)
    placed = above.placed
    x_m, y_m = np.round(above.points_m, 2).T.tolist()
    body: dict[str, Any] = {
        "revision": revision,
        "parts": above.sizes(),
        "pieces": above.pieces(),
        "goals": [[printable(name), *goal] for name, goal in above.goals.items()],
        "by": {by: _colours(above.labels(by)) for by in COLOURS},
        "node": [str(UUID(bytes=uuid.tobytes())) for uuid in placed.uuids],
        "x": x_m,
        "y": y_m,
        "part": above.part.tolist(),
        "chain": placed.experience.tolist(),
        "added": placed.revision.tolist(),
        "starts": np.flatnonzero(above.starts).tolist(),
    }
    return json.dumps(body, separators=(",", ":")).encode()


def weak_spots(store: Map) -> bytes:
    """The weak spots of a revision as JSON, in the words and colours of ``engram report``.

    Nodes are numbered as in `drawn`. `Map.derived` keeps it, as it reads the whole map.
    """
    found, above = store.derived(find_weak_spots), map_above(store)
    places = places_above(found, store, above)
    rows = spot_rows(found, store)[:_SPOTS]
    spots = [
        {
            **dict(zip(HEAD, row, strict=True)),
            "share": one.missed,
            "length_m": one.to_m - one.from_m,
            "nodes": nodes_along(one, found, store, places).tolist(),
        }
        for one, row in zip(found.spots, rows, strict=False)
    ]
    advice = found.advice and {
        "text": advice_text(found.advice, store),
        "nodes": nodes_along(found.advice, found, store, places).tolist(),
    }
    body: dict[str, Any] = {
        "revision": store.revision,
        "verdict": verdict(found),
        "unknown_hours": unknown_hours_text(found),
        "spots": spots,
        "more": len(found.spots) - len(spots),
        "advice": advice,
        "colours": _colours(weakness_labels(found, places)),
    }
    return json.dumps(body, separators=(",", ":")).encode()


@lru_cache(maxsize=_KEPT)
def weak_spots_of(path: Path, version: str, revision: int) -> bytes:
    """`weak_spots` of a revision that is not the newest, kept by version as in `drawn`."""
    del version
    with Map.open(path, at=revision) as store:
        return weak_spots(store)


def _colours(labels: Labels) -> dict[str, Any]:
    return {
        "names": [printable(name) for name in labels.names],
        "colours": labels.colours,
        "of": labels.of_node.tolist(),
    }


def thumbnail(store: Map, node: str) -> bytes | None:
    """The small picture of a node, JPEG; None if it was not sent."""
    origin = store.origin(node)
    if origin.node not in store.graph:
        return None
    record = store.graph.node(store.graph.index(origin.node))
    return next(iter(store.frames.stored([record]))).thumbnail


def changes(store: Map, revision: int) -> dict[str, Any]:
    """What a revision changed: lines for people, and some of the nodes that it added."""
    found = store.diff(max(revision - 1, 0), revision)
    added = sorted(str(node) for node in found.added)
    return {"lines": change_lines(found), "nodes": added[:_PICTURES]}


def change_lines(found: MapDifference) -> list[str]:
    """What changed between two revisions, a fact a line."""
    old, new = found.old, found.new
    nodes = _moved(len(found.added), len(found.removed)) or "no node added or removed"
    lines = [f"{nodes}: {new.nodes} in the map"]
    if old.nodes and round(new.mapped_m) != round(old.mapped_m):
        lines.append(f"{old.mapped_m:.0f} m of road mapped before, {new.mapped_m:.0f} m after")
    if old.nodes and new.components != old.components:
        lines.append(f"{counted(old.components, 'part')} before, {new.components} after")
    drives = dict.fromkeys(one.oldest.id for one in found.regions)
    return lines + [
        _region_line([one for one in found.regions if one.oldest.id == drive]) for drive in drives
    ]


def _region_line(stretches: list[Region]) -> str:
    moved = _moved(sum(one.added for one in stretches), sum(one.removed for one in stretches))
    first_m, last_m = min(one.from_m for one in stretches), max(one.to_m for one in stretches)
    drive = drive_text(stretches[0].oldest)
    return f"{moved} between {first_m:.0f} and {last_m:.0f} m into the drive of {drive}"


def _moved(added: int, removed: int) -> str:
    counts = (("added", added), ("removed", removed))
    return ", ".join(f"{counted(count, 'node')} {what}" for what, count in counts if count)
