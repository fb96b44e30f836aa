"""Content and integrity of a map, as plain values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from engram.graph.clock import hour_of_day, zone_note
from engram.graph.model import Amendable, path_id
from engram.maps import FORMAT_VERSION, Map, check_file
from engram.maps.history import stamp_text
from engram.places.words import vocabulary_problems


def describe_map(path: Path, at: int | str | None = None) -> dict[str, Any]:
    """Counts and properties of a map, for ``engram info``.

    Raises:
        MapError: the map cannot be read.
    """
    with Map.open(path, at=at) as store:
        info = store.info()
        components = Counter(store.graph.components().tolist())
        return {
            "format_version": FORMAT_VERSION,
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
    """The sessions of a map in order of arrival, for ``engram info --sessions``.

    Raises:
        MapError: the map cannot be read, or has no such revision.
    """
    with Map.open(path, at=at) as store:
        contents = store.load()
        frontends = store.frontends
        amended = {(one.session, str(one.what)) for one in store.amendments}
    nodes = Counter(node.session for node in contents.nodes)
    entries = Counter(entry.path for entry in contents.path_entries)
    return [
        {
            "session": str(one.id),
            "robot": one.robot,
            "camera": one.camera,
            "start": stamp_text(one, one.start_ns),
            "start_ns": one.begin_ns,
            "clock": str(one.clock),
            "longitude_deg": one.longitude_deg,
            "zone": one.zone,
            "hour": hour_of_day(one, one.start_ns),
            "note": zone_note(one),
            "nodes": nodes[one.id],
            "path_entries": entries[path_id(one.id)],
            "descriptor": str(frontends[one.id][0]),
            "amended": sorted(what for session, what in amended if session == one.id),
        }
        for one in contents.sessions
    ]


def list_nodes(path: Path, at: int | str | None = None) -> list[dict[str, Any]]:
    """The nodes of a map in order of arrival, for ``engram info --nodes``.

    Raises:
        MapError: the map cannot be read, or has no such revision.
    """
    with Map.open(path, at=at) as store:
        graph, sessions = store.graph, store.sessions
    components, experiences = graph.components(), graph.experiences
    return [
        {
            "node": str(node.id),
            "session": str(node.session),
            "robot": sessions[node.session].robot,
            "when": stamp_text(sessions[node.session], node.stamp_ns),
            "stamp_ns": node.stamp_ns,
            "hour": hour_of_day(sessions[node.session], node.stamp_ns),
            "driven_m": node.driven_m,
            "experience": int(experiences[index]),
            "component": int(components[index]),
        }
        for index, node in enumerate(graph.nodes)
    ]


def amend_session(
    path: Path,
    session: str,
    changes: Mapping[Amendable, str],
    *,
    author: str,
) -> dict[str, Any]:
    """Corrects the robot, zone or start of a session, for ``engram amend``; see `Map.amend`.

    Args:
        path: NAME.engram.
        session: its UUID, or an unambiguous prefix.
        changes: field → its correct value.
        author: author of the revision.

    Raises:
        InputError: the prefix matches no session or several, or nothing would change.
        ConfigError: the zone is unknown.
        MapError: the map cannot be written.
    """
    with Map.open(path) as store:
        found = store.named_session(session).id
        revision = store.amend(found, changes, author=author)
        shown = store.sessions[found]
    return {
        "session": str(found),
        "revision": revision.number,
        "robot": shown.robot,
        "start": stamp_text(shown, shown.start_ns),
        "zone": shown.zone,
    }


def check_map(path: Path, *, clean: bool = False) -> dict[str, Any]:
    """Checks a map for damage, for ``engram check``.

    Raises:
        MapError: the file is not a map, has a newer format, or is too damaged to open.
    """
    removed = 0
    if clean:
        with Map.open(path, writes=True) as store:
            removed = store.clean()
    report = check_file(path)
    problems = [*report.problems, *vocabulary_problems(path)]
    return {
        "sound": not problems,
        "problems": [
            {"table": one.table, "record": one.record, "fact": one.fact} for one in problems
        ],
        "rows": report.rows,
        "blobs": report.blobs,
        "interrupted": [str(session) for session in report.interrupted],
        "abandoned_rows": report.abandoned_rows,
        "removed_rows": removed,
    }


def seal_map(path: Path) -> list[dict[str, Any]]:
    """Commits the saved part of interrupted sessions, for ``engram check --seal``.

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
