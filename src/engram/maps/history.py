"""The history of a map, as in version control: log, show, tag, revert, blame."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from engram.counts import counted
from engram.graph.clock import hour_of_day, zone_note
from engram.graph.model import Clock, Session
from engram.maps.difference import MapDifference
from engram.maps.map import open_map
from engram.maps.records import Revision
from engram.maps.tags import Tag

# Contents of a revision, in the order in which `log` prints them.
_TOLD = {
    "sessions": ("session", ""),
    "nodes": ("node", ""),
    "edges": ("edge", ""),
    "path_entries": ("path entry", ""),
    "attempts": ("attempt", ""),
    "omissions": ("node", " omitted"),
    "vocabularies": ("vocabulary", ""),
    "amendments": ("amendment", ""),
    "removals": ("edge", " removed"),
    "placements": ("node", " placed"),
    "anchors": ("anchor", ""),
    "goals": ("goal", ""),
    "forgotten": ("id", " forgotten"),
    "hidden": ("row", " hidden or shown again"),
}


def map_log(path: Path, at: int | str | None = None) -> list[dict[str, Any]]:
    """The revisions of a map, newest first, for ``engram log``.

    Raises:
        MapError: the map cannot be read, or has no such revision.
    """
    with open_map(path, at=at) as store:
        names = _names(store.tags())
        return [_revision(one, names) for one in reversed(store.log())]


def log_text(revision: Mapping[str, Any], *, oneline: bool = False) -> str:
    """One revision of `map_log` as text."""
    tags = f" (tag: {', '.join(revision['tags'])})" if revision["tags"] else ""
    message = revision["message"]
    if oneline:
        return f"{revision['number']:5d}  {revision['when']}  {revision['author']}: {message}{tags}"
    lines = [
        f"revision {revision['number']}{tags}",
        f"Author: {revision['author']} on {revision['host']}",
        f"Date:   {revision['when']}",
        f"        {_contents_text(revision['contents'])}",
    ]
    lines += ["", *(f"    {line}" for line in message.splitlines()), ""] if message else [""]
    return "\n".join(lines)


def show_revision(path: Path, named: int | str) -> tuple[dict[str, Any], MapDifference]:
    """One revision and its changes to the map.

    Raises:
        MapError: the map cannot be read, or has no such revision.
    """
    with open_map(path, at=named) as store:
        revision, tags = store.newest_revision(), _names(store.tags())
        number = store.revision
        shown = {
            **({} if revision is None else _revision(revision, tags)),
            "number": number,
            "content_hash": store.content_hash(),
            "configuration": {} if revision is None else dict(revision.configuration),
        }
        return shown, store.diff(max(number - 1, 0), number)


def map_tags(path: Path) -> list[dict[str, Any]]:
    """The tags of a map, by name.

    Raises:
        MapError: the map cannot be read.
    """
    with open_map(path) as store:
        return [tag_dict(tag) for tag in store.tags().values()]


def tag_dict(tag: Tag) -> dict[str, Any]:
    """A tag as plain values."""
    return {
        "name": tag.name,
        "revision": tag.number,
        "author": tag.author,
        "message": tag.message,
        "when": when(tag.tagged_ns),
    }


def blame_node(path: Path, prefix: str) -> dict[str, Any]:
    """The origin and history of a node.

    Raises:
        InputError: no node or several match.
        MapError: the map cannot be read.
    """
    with open_map(path) as store:
        origin = store.origin(prefix)
        brought = store.newest_revision(origin.brought)
        session = store.sessions.get(origin.session)
    assert brought is not None
    return {
        "node": str(origin.node),
        "robot": origin.robot,
        "session": str(origin.session),
        "when": stamp_text(session, origin.stamp_ns),
        "stamp_ns": origin.stamp_ns,
        "hour": None if session is None else hour_of_day(session, origin.stamp_ns),
        "note": "" if session is None else zone_note(session),
        "driven_m": origin.driven_m,
        "revision": origin.brought,
        "author": brought.author,
        "committed": when(brought.committed_ns),
        "message": brought.message,
        "visible": origin.visible,
        "told": [{"revision": by, "hidden": hidden} for by, hidden in origin.told],
        "edges": dict(origin.edges),
        "paths": origin.paths,
        "attempts": origin.attempts,
        "matches": origin.matches,
    }


def blame_text(found: Mapping[str, Any]) -> str:
    """`blame_node` as text."""
    hour = "hour of day unknown" if found["hour"] is None else f"hour of day {found['hour']:.2f}"
    edges = ", ".join(f"{count} {kind}" for kind, count in found["edges"].items()) or "none"
    lines = [
        f"node {found['node']}",
        f"  saved by {found['robot']} in session {found['session']}, {found['driven_m']:.1f} m in",
        f"  at {found['when']}, {hour}",
        f"  added by revision {found['revision']} of {found['author']}, {found['committed']}"
        + (f": {found['message']}" if found["message"] else ""),
        f"  edges: {edges}; on {counted(found['paths'], 'path')}; matched in "
        f"{found['matches']} of {counted(found['attempts'], 'attempt')}",
    ]
    for said in found["told"]:
        done = "hidden" if said["hidden"] else "shown again"
        lines.append(f"  {done} by revision {said['revision']}")
    return "\n".join(lines)


def when(stamp_ns: int) -> str:
    """UTC, to the second."""
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).isoformat(timespec="seconds")


def stamp_text(session: Session | None, stamp_ns: int) -> str:
    """A stamp of a session as text; None for an invisible session."""
    if session is not None and session.clock is Clock.UTC:
        return when(stamp_ns + session.shift_ns)
    return f"{stamp_ns / 1e9:.3f} s of a clock that is not UTC"


def _names(tags: Mapping[str, Tag]) -> dict[int, list[str]]:
    names: dict[int, list[str]] = {}
    for tag in tags.values():
        names.setdefault(tag.number, []).append(tag.name)
    return names


def _revision(revision: Revision, names: Mapping[int, list[str]]) -> dict[str, Any]:
    return {
        "number": revision.number,
        "parent": revision.parent,
        "when": when(revision.committed_ns),
        "author": revision.author,
        "host": revision.host,
        "message": revision.message,
        "tool_version": revision.tool_version,
        "tags": names.get(revision.number, []),
        "contents": dict(revision.contents),
    }


def _contents_text(contents: Mapping[str, float]) -> str:
    told = [
        counted(int(contents[key]), thing) + done
        for key, (thing, done) in _TOLD.items()
        if contents.get(key)
    ]
    if contents.get("mapped_m"):
        told.append(f"{contents['mapped_m']:.1f} m mapped")
    return ", ".join(told) or "nothing"
