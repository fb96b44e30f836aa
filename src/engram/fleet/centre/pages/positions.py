"""Where a map's nodes are drawn, and what colours them."""

from __future__ import annotations

import json
from contextlib import closing
from functools import lru_cache
from pathlib import Path
from typing import Any

from engram.graph.clock import hour_of_day
from engram.maps.exchange import MapRows
from engram.maps.map import Map
from engram.maps.schema import nodes, revisions

_KEPT = 8


@lru_cache(maxsize=_KEPT)
def drawn(path: Path, version: str, revision: int) -> bytes:
    """The nodes of a revision as JSON, in the map frame; kept by version."""
    del version  # names the revision permanently; after a restore the number alone does not
    with Map.open(path, at=revision) as store:
        points = store.layout().positions
        sessions = list(store.sessions.values())
        place = {session.id: at for at, session in enumerate(sessions)}
        brought = _brought(path, revision)
        found = [
            [
                str(node.id),
                round(float(points[at, 0]), 2),
                round(float(points[at, 1]), 2),
                place[node.session],
                brought[node.id.bytes],
                _hour(sessions[place[node.session]], node.stamp_ns),
            ]
            for at, node in enumerate(store.graph.nodes)
        ]
    body: dict[str, Any] = {
        "revision": revision,
        "sessions": [
            {"id": str(session.id), "robot": session.robot, "start_ns": session.start_ns}
            for session in sessions
        ],
        "nodes": found,
    }
    return json.dumps(body, separators=(",", ":")).encode()


def thumbnail(store: Map, node: str) -> bytes | None:
    """The small picture of a node, JPEG; None if it was not sent."""
    origin = store.origin(node)
    if origin.node not in store.graph:
        return None
    record = store.graph.node(store.graph.index(origin.node))
    return next(iter(store.frames.stored([record]))).thumbnail


def _hour(session: Any, stamp_ns: int) -> float | None:
    hour = hour_of_day(session, stamp_ns)
    return None if hour is None else round(float(hour), 2)


def _brought(path: Path, revision: int) -> dict[bytes, int]:
    """The revision that added each node."""
    with closing(MapRows(path, revision)) as rows:
        numbers = {row[0]: row[1] for row in rows.of(revisions)}
        return {row[1]: numbers[row[2]] for row in rows.of(nodes)}
