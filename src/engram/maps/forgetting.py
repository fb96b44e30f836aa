"""Forgets drives, nodes and pictures: first hidden by a revision, then erased from the file.

A revision of forgetting hides rows as a revert does, and names in `forgotten` what may not be taken
in again. Reverting it undoes both. What is erased leaves a receipt for each row, by whose digests
the history still verifies.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from sqlalchemy import Connection, Table, delete, func, insert, select, update

from engram.counts import counted
from engram.errors import RevisionError
from engram.files import WriterLock
from engram.graph.model import Edge, NodeId, SessionId
from engram.maps.columns import Visible, stretches
from engram.maps.content import Identities, row_digests
from engram.maps.hiding import hidden_row
from engram.maps.place_blocks import PLACES_PER_BLOCK
from engram.maps.revisions import collect_abandoned, open_sessions
from engram.maps.rows import edge_row, sealed, verified
from engram.maps.schema import (
    VERSIONED,
    amendments,
    anchors,
    attempts,
    edges,
    forgotten,
    frames,
    goals,
    hidden,
    metadata,
    nodes,
    omissions,
    omitted_landmarks,
    path_entries,
    paths,
    place_blocks,
    placements,
    receipts,
    removals,
    sessions,
    words,
)
from engram.maps.sqlite import SqliteDatabase, alone, compact
from engram.maps.totals import Totals, totals_at
from engram.maps.view import KeyBook, View, few, head

# Keys of rows by table, each with the revision that forgot it.
Gone: TypeAlias = Mapping[Table, Mapping[int, int]]
# Rows of a table by key: their revisions, and those that forgot them.
Found: TypeAlias = Mapping[int, tuple[int, int]]
# Columns by which rows go with others, and the tables of these. What is at a hidden node is hidden
# with it, so that only these rows are hidden by themselves.
_HIDDEN_WITH: dict[Table, dict[str, Table]] = {
    nodes: {"session": sessions},
    paths: {"session": sessions},
    path_entries: {"path": paths},
    omissions: {"node": nodes},
    attempts: {"session": sessions},
    amendments: {"session": sessions},
}
_ERASED_WITH: dict[Table, dict[str, Table]] = {
    **_HIDDEN_WITH,
    path_entries: {"path": paths, "node": nodes},
    frames: {"node": nodes},
    edges: {"a": nodes, "b": nodes},
    removals: {"a": nodes, "b": nodes},
    placements: {"node": nodes},
    anchors: {"node": nodes},
    goals: {"node": nodes},
}


class NothingToForgetError(RevisionError):
    """A map holds nothing of what it is to forget."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """What is to be forgotten.

    Attributes:
        sessions: with all that they saved, passed and tried.
        nodes: of other sessions.
        pictures: whether only the pictures of all these nodes go.
    """

    sessions: frozenset[SessionId] = frozenset()
    nodes: frozenset[NodeId] = frozenset()
    pictures: bool = False


@dataclass(frozen=True, slots=True)
class Forgotten:
    """The result of forgetting, or of a dry run.

    Attributes:
        revision: number of the new revision; None if nothing was written.
        sessions, nodes, edges, path_entries, attempts, pictures: number of those that go.
        bridges: number of edges composed over them.
        size_bytes: of the landmarks and pictures that go.
        components: number of connected components before and after.
    """

    revision: int | None
    sessions: int
    nodes: int
    edges: int
    path_entries: int
    attempts: int
    pictures: int
    bridges: int
    size_bytes: int
    components: tuple[int, int]

    def text(self) -> str:
        """The result as text."""
        kinds = (
            (self.sessions, "session"),
            (self.nodes, "node"),
            (self.edges, "edge"),
            (self.path_entries, "path entry"),
            (self.attempts, "attempt"),
            (self.pictures, "picture"),
        )
        what = ", ".join(counted(number, name) for number, name in kinds if number)
        done = "would go" if self.revision is None else f"forgotten by revision {self.revision}"
        lines = [f"{done}: {what}; {self.size_bytes / 1e6:.1f} MB of landmarks and pictures"]
        if self.bridges:
            lines.append(f"composed over them: {counted(self.bridges, 'edge')}")
        before, after = self.components
        if after > before:
            lines.append(f"the map falls apart: {before} → {counted(after, 'component')}")
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class Erased:
    """The result of an erasure.

    Attributes:
        rows: number of rows erased by table; each has left a receipt.
        pictures: number of erased ones.
        before_bytes: size of the file.
        after_bytes: the same afterwards; None for a dry run.
    """

    rows: Mapping[str, int]
    pictures: int
    before_bytes: int
    after_bytes: int | None

    def text(self) -> str:
        """The result as text."""
        done = "would be erased:" if self.after_bytes is None else "erased"
        size = ""
        if self.after_bytes is not None:
            size = f"; {self.before_bytes / 1e6:.1f} → {self.after_bytes / 1e6:.1f} MB"
        return (
            f"{done} {counted(self.rows.get(nodes.name, 0), 'node')} of "
            f"{counted(self.rows.get(sessions.name, 0), 'session')} with "
            f"{counted(sum(self.rows.values()), 'row')} in all, and "
            f"{counted(self.pictures, 'picture')}{size}"
        )


def forgotten_of(connection: Connection, view: View, some: Sequence[bytes]) -> set[bytes]:
    """Those of some UUIDs of sessions or nodes that a map has forgotten."""
    named = view.select(forgotten).with_only_columns(forgotten.c.uuid).order_by(None)
    if connection.execute(select(forgotten.c.key).limit(1)).first() is None:
        return set()
    parts = (connection.execute(named.where(forgotten.c.uuid.in_(part))) for part in few(some))
    return {uuid for part in parts for uuid in part.scalars()}


def hide_chosen(
    connection: Connection, keys: KeyBook, view: View, revision_key: int, chosen: Chosen
) -> Mapping[Table, Sequence[int]]:
    """Hides what is chosen, and names it in `forgotten`; returns the keys of hidden rows.

    Args:
        connection: inside a transaction.
        keys: the writer's.
        view: the newest revision, and the open one.
        revision_key: key of the open revision.
        chosen: what goes.
    """
    (seen,) = Visible.of(connection, view)
    named: dict[Table, dict[int, int]] = {
        table: dict.fromkeys(_visible_keys(connection, seen, table, some), revision_key)
        for table, some in ((sessions, chosen.sessions), (nodes, chosen.nodes))
    }
    gone = dict(named)
    if chosen.pictures:
        gone = {frames: _with_pictures(connection, seen, _with_those_of(connection, gone, nodes))}
    else:
        for table, columns in _HIDDEN_WITH.items():
            found = _going_with(connection, table, columns, gone)
            gone[table] = gone.get(table, {}) | _seen_of(seen, table, found)
        hashes = _hashes_of(connection, gone[omissions])
        gone[omitted_landmarks] = _seen_of(seen, omitted_landmarks, hashes)
        for kind, uuids in _named_with(connection, named).items():
            write_names(connection, keys, revision_key, kind, uuids)
    for table, targets in gone.items():
        rows = [hidden_row(keys, revision_key, table, one, hide=True) for one in sorted(targets)]
        if rows:
            connection.execute(insert(hidden), rows)
    return {table: sorted(targets) for table, targets in gone.items()}


def _seen_of(seen: Visible, table: Table, found: Found) -> dict[int, int]:
    return {key: cause for key, (of, cause) in found.items() if seen.has(table, key, of)}


def _visible_keys(
    connection: Connection, seen: Visible, table: Table, some: Iterable[SessionId | NodeId]
) -> list[int]:
    found = []
    for part in few(sorted(one.bytes for one in some)):
        query = select(table.c.key, table.c.revision).where(table.c.uuid.in_(part))
        rows = connection.execute(query.order_by(table.c.key))
        found += [key for key, revision in rows if seen.has(table, key, revision)]
    return found


def _going_with(
    connection: Connection, table: Table, columns: Mapping[str, Table], gone: Gone
) -> Found:
    """Rows of a table that go with others."""
    key, found = table.primary_key.columns[0], dict[int, tuple[int, int]]()
    for name, owner in columns.items():
        causes = gone[owner]
        for first, last in stretches(causes):
            query = select(key, table.c.revision, table.c[name])
            rows = connection.execute(query.where(table.c[name].between(first, last)))
            found.update((one, (revision, causes[to])) for one, revision, to in rows)
    return found


def _with_those_of(connection: Connection, gone: Gone, table: Table) -> dict[int, int]:
    """Rows of a table that go by themselves or with their sessions."""
    owned = _going_with(connection, table, {"session": sessions}, gone)
    return dict(gone[table]) | _causes(owned)


def _with_pictures(
    connection: Connection, seen: Visible, among: Mapping[int, int]
) -> dict[int, int]:
    found: dict[int, int] = {}
    for first, last in stretches(among):
        query = select(frames.c.node).where(frames.c.node.between(first, last))
        some = connection.execute(query.where(frames.c.thumbnail.is_not(None))).scalars()
        found.update((key, among[key]) for key in some)
    return {key: cause for key, cause in found.items() if key not in seen.hidden_of(frames)}


def _hashes_of(connection: Connection, gone: Mapping[int, int]) -> Found:
    """The rows of `omitted_landmarks` of omissions."""
    found: dict[int, tuple[int, int]] = {}
    theirs = omitted_landmarks.c.key, omitted_landmarks.c.revision
    both = omitted_landmarks.join(omissions, omissions.c.uuid == omitted_landmarks.c.uuid)
    for first, last in stretches(gone):
        query = select(*theirs, omissions.c.key).select_from(both)
        rows = connection.execute(query.where(omissions.c.key.between(first, last)))
        found.update((key, (revision, gone[omission])) for key, revision, omission in rows)
    return found


def _named_with(connection: Connection, named: Gone) -> dict[Table, list[bytes]]:
    """UUIDs by what they name: sessions, and nodes that are chosen by themselves.

    With these go the nodes that were omitted for them. Those omitted for nodes of a whole session
    are of other drives, which may hand them in again.
    """
    omitted = _going_with(connection, omissions, {"node": nodes}, named)
    parts = (
        (sessions, sessions, named[sessions]),
        (nodes, nodes, named[nodes]),
        (nodes, omissions, omitted),
    )
    found: dict[Table, dict[bytes, None]] = {sessions: {}, nodes: {}}
    for kind, table, some in parts:
        for first, last in stretches(some):
            query = select(table.c.uuid).where(table.c.key.between(first, last))
            found[kind] |= dict.fromkeys(connection.execute(query.order_by(table.c.key)).scalars())
    return {kind: list(uuids) for kind, uuids in found.items()}


def write_names(
    connection: Connection, keys: KeyBook, revision_key: int, kind: Table, uuids: Iterable[bytes]
) -> None:
    """Names sessions or nodes that may not be taken in again, in an open revision."""
    rows = [
        {"revision": revision_key, "record": str(kind.name), "uuid": uuid, "key": key}
        for uuid in uuids
        for key in [keys.next(forgotten)]
    ]
    if rows:
        connection.execute(insert(forgotten), [sealed(forgotten, row) for row in rows])


def load_names(connection: Connection, view: View) -> dict[Table, list[bytes]]:
    """All that `write_names` takes, of a map."""
    found: dict[Table, list[bytes]] = {sessions: [], nodes: []}
    for row in view.rows(connection, forgotten):
        found[metadata.tables[row["record"]]].append(row["uuid"])
    return found


def write_bridges(
    connection: Connection, keys: KeyBook, revision_key: int, bridges: Iterable[Edge]
) -> None:
    """Writes edges between nodes of a map into an open revision."""
    for bridge in bridges:
        a, b = keys.find_node(bridge.a), keys.find_node(bridge.b)
        assert a is not None
        assert b is not None
        row = edge_row(bridge, keys.next(edges), revision_key, a, b)
        connection.execute(insert(edges), [sealed(edges, row)])


def result_of(
    connection: Connection, number: int, gone: Mapping[Table, Sequence[int]], bridges: int
) -> Forgotten:
    """What the revision of this number has forgotten, with the keys of what it hid."""
    before, after = totals_at(connection, number - 1), totals_at(connection, number)
    pictures, size_bytes = 0, 0
    lengths = func.length(frames.c.landmarks), func.length(frames.c.thumbnail)
    for table in (nodes, frames):
        for first, last in stretches(gone.get(table, ())):
            query = select(*lengths).where(frames.c.node.between(first, last))
            for landmarks, picture in connection.execute(query):
                pictures += picture is not None
                size_bytes += (picture or 0) + (landmarks if table is nodes else 0)
    return Forgotten(
        number,
        before.sessions - after.sessions,
        before.nodes - after.nodes,
        _edges(before) - _edges(after) + bridges,
        before.path_entries - after.path_entries,
        before.attempts - after.attempts,
        pictures,
        bridges,
        size_bytes,
        (before.components, after.components),
    )


def _edges(totals: Totals) -> int:
    return sum(totals.edges.values())


# -- erasing


def erase_map(path: Path, *, dry_run: bool = False) -> Erased:
    """Erases what a map has forgotten from its file, which no other process may have open.

    One transaction writes the receipts and removes the rows; then the file is rewritten without
    what its free pages held. Killed before that, the same call does the rest.

    Args:
        path: the map.
        dry_run: only report what would be erased.

    Raises:
        MapLockedError: another process has it open, or this one.
        RevisionError: it holds an interrupted session.
        StorageFullError: no space to rewrite the file; the map is sound.
        MapError: it cannot be written.
    """
    path = path.resolve()
    SqliteDatabase(path).close()  # refuses what is not a map of this format
    lock, before_bytes = WriterLock(path), path.stat().st_size
    try:
        with alone(path) as engine:
            with engine.begin() as connection:
                if open_sessions(connection):
                    raise RevisionError(
                        f"{path} holds an interrupted session, whose rows may refer to what is "
                        "erased: map its drive again, or engram check --seal"
                    )
                collect_abandoned(connection)
                rows, pictures = _erase(connection)
                if dry_run:
                    connection.rollback()
            if not dry_run:
                compact(engine)
    finally:
        lock.release()
    after_bytes = None if dry_run else path.stat().st_size
    return Erased(rows, pictures, before_bytes, after_bytes)


def _erase(connection: Connection) -> tuple[dict[str, int], int]:
    """Number of erased rows by table, and of pictures."""
    (seen,) = Visible.of(connection, View(head(connection)))
    gone: dict[Table, dict[int, int]] = {
        table: _forgotten_keys(connection, seen, table) for table in (sessions, nodes)
    }
    for table, columns in _ERASED_WITH.items():
        found = _going_with(connection, table, columns, gone)
        gone[table] = gone.get(table, {}) | _causes(found)
    gone[omitted_landmarks] = _causes(_hashes_of(connection, gone[omissions]))
    pictures = _erase_pictures(connection, seen.hidden_of(frames) - gone[frames].keys())
    _write_receipts(connection, gone)
    for table, targets in gone.items():
        key = table.primary_key.columns[0]
        for first, last in stretches(targets):
            connection.execute(delete(table).where(key.between(first, last)))
    for first, last in stretches(gone[nodes]):
        connection.execute(delete(words).where(words.c.node.between(first, last)))
        low, high = ((key - 1) // PLACES_PER_BLOCK for key in (first, last))
        connection.execute(delete(place_blocks).where(place_blocks.c.block.between(low, high)))
    return {str(table.name): len(targets) for table, targets in gone.items() if targets}, pictures


def _causes(found: Found) -> dict[int, int]:
    return {key: cause for key, (_, cause) in found.items()}


def _forgotten_keys(connection: Connection, seen: Visible, table: Table) -> dict[int, int]:
    """Keys of the hidden rows of a table that `forgotten` names, each with the revision of that."""
    query = (
        select(forgotten.c.key, forgotten.c.revision, table.c.key)
        .select_from(forgotten.join(table, table.c.uuid == forgotten.c.uuid))
        .where(forgotten.c.record == table.name)
        .order_by(forgotten.c.key)
    )
    gone = seen.hidden_of(table)
    return {
        key: cause
        for name, cause, key in connection.execute(query)
        if key in gone and seen.has(forgotten, name, cause)
    }


def _erase_pictures(connection: Connection, keys: Iterable[int]) -> int:
    """Erases the pictures of these nodes, whose frames stay; returns how many there were."""
    count = 0
    for key in sorted(keys):
        query = select(frames).where(frames.c.node == key, frames.c.thumbnail.is_not(None))
        for row in verified(frames, connection.execute(query)):
            values = sealed(frames, row | {"thumbnail": None})
            connection.execute(update(frames).where(frames.c.node == key).values(values))
            count += 1
    return count


def _write_receipts(connection: Connection, gone: Gone) -> None:
    known, erased_ns = Identities(connection), time.time_ns()
    next_key = 1 + (connection.execute(select(func.max(receipts.c.key))).scalar() or 0)
    for table in (one for one in VERSIONED if gone.get(one)):
        for part in few(sorted(gone[table])):
            digests = row_digests(connection, table, part, known)
            rows = [
                {
                    "key": next_key + at,
                    "record": str(table.name),
                    "target": key,
                    "revision": revision,
                    "uuid": uuid,
                    "count": count,
                    "digest": digests[key],
                    "forgotten": gone[table][key],
                    "erased_ns": erased_ns,
                }
                for at, (key, revision, uuid, count) in enumerate(_facts(connection, table, part))
            ]
            connection.execute(insert(receipts), [sealed(receipts, row) for row in rows])
            next_key += len(rows)


def _facts(
    connection: Connection, table: Table, keys: Sequence[int]
) -> Iterator[tuple[int, int, bytes | None, int]]:
    """Key, revision, UUID and number of what they hold, of rows."""
    key = table.primary_key.columns[0]
    rows = connection.execute(select(table).where(key.in_(keys)).order_by(key)).mappings()
    for row in rows:
        yield row[key], row["revision"], row.get("uuid"), row.get("count", 1)
