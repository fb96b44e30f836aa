"""What a map holds and whether it is sound, as plain values."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from engram.maps import Map, check_file
from engram.maps.history import sessions_of


def describe_map(path: Path, at: int | str | None = None) -> dict[str, Any]:
    """A map in numbers, for ``engram info``.

    Raises:
        MapError: the map cannot be read.
    """
    with Map.open(path, at=at) as store:
        info = store.info()
        components = Counter(store.graph.components().tolist())
        return {
            "format_version": info.format_version,
            "revision": info.revision,
            "content_hash": store.content_hash(),
            "descriptor": info.descriptor,
            "sessions": info.sessions,
            "robots": sorted({session.robot for session in store.sessions.values()}),
            "cameras": info.cameras,
            "nodes": info.nodes,
            "experiences": len(set(store.graph.experiences.tolist())),
            "edges": dict(info.edges_of_kind),
            "components": len(components),
            "largest_component": max(components.values(), default=0),
            "paths": len(store.path_memory),
            "path_entries": info.path_entries,
            "attempts": info.attempts,
            "mapped_m": info.mapped_m,
            "size_bytes": info.size_bytes,
            "interrupted": [str(one.session.id) for one in store.interrupted()],
        }


def list_sessions(path: Path, at: int | str | None = None) -> list[dict[str, Any]]:
    """The sessions of a map, for ``engram info --sessions``.

    Raises:
        MapError: the map cannot be read.
    """
    with Map.open(path, at=at) as store:
        return sessions_of(store.load())


def list_nodes(path: Path, at: int | str | None = None) -> list[dict[str, Any]]:
    """The nodes of a map, for ``engram info --nodes``.

    Raises:
        MapError: the map cannot be read.
    """
    with Map.open(path, at=at) as store:
        return [
            {
                "node": str(node.id),
                "session": str(node.session),
                "stamp_ns": node.stamp_ns,
                "driven_m": node.driven_m,
            }
            for node in store.load().nodes
        ]


def check_map(path: Path, *, clean: bool = False) -> dict[str, Any]:
    """What is wrong with a map, for ``engram check``.

    Raises:
        MapError: the file is no map, of a newer format, or too damaged to be store.
    """
    removed = 0
    if clean:
        with Map.open(path, writes=True) as store:
            removed = store.clean()
    report = check_file(path)
    return {
        "sound": report.sound,
        "problems": [
            {"table": one.table, "record": one.record, "fact": one.fact} for one in report.problems
        ],
        "rows": report.rows,
        "blobs": report.blobs,
        "interrupted": [str(session) for session in report.interrupted],
        "abandoned_rows": report.abandoned_rows,
        "removed_rows": removed,
    }


def seal_map(path: Path) -> list[dict[str, Any]]:
    """Commits what interrupted sessions had saved, for ``engram seal``.

    Raises:
        MapError: the map cannot be written.
    """
    with Map.open(path, writes=True) as store:
        return [
            {
                "session": str(one.session.id),
                "nodes": one.nodes,
                "revision": store.seal(one.session.id).number,
            }
            for one in store.interrupted()
        ]
