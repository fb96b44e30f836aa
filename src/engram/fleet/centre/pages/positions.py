"""Where a map's nodes are drawn, and what colours them."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np

from engram.graph.clock import hour_of_day
from engram.maps.map import Map

_KEPT = 8


@lru_cache(maxsize=_KEPT)
def drawn(path: Path, version: str, revision: int) -> bytes:
    """The nodes of a revision as JSON, in the map frame; kept by version."""
    del version  # names the revision permanently; after a restore the number alone does not
    with Map.open(path, at=revision) as store:
        placed = store.placed()
    sessions = placed.sessions
    columns = (placed.session, placed.stamp_ns, placed.revision)
    found = [
        [
            str(UUID(bytes=uuid.tobytes())),
            x_m,
            y_m,
            session,
            number,
            _hour(sessions[session], stamp_ns),
        ]
        for uuid, (x_m, y_m), session, stamp_ns, number in zip(
            placed.uuids,
            np.round(placed.positions[:, :2], 2).tolist(),
            *(column.tolist() for column in columns),
            strict=True,
        )
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
