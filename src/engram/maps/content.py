"""The content hash: equal for equal maps, independent of place and time (method §7.5)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Table, select

from engram.errors import MapCorruptError
from engram.graph.paths import Attempts
from engram.maps.attempts import COLUMNS, unpack
from engram.maps.reading import load_cameras, load_frontends
from engram.maps.rows import Row, verified, verified_values
from engram.maps.schema import (
    VERSIONED,
    attempts,
    frames,
    hidden,
    nodes,
    paths,
    placements,
    revisions,
    sessions,
)
from engram.maps.view import View

_encode = msgspec.msgpack.Encoder().encode

# The table that a column refers to: keys differ between equal maps, so UUIDs replace them.
_REFERENCES = {
    "revision": "revisions",
    "session": "sessions",
    "camera": "cameras",
    "frontend": "frontends",
    "node": "nodes",
    "a": "nodes",
    "b": "nodes",
    "path": "paths",
}
# Landmarks count by their hashes. Thumbnails are left out, since decoders differ, and placements,
# since they follow from the rest to the rounding of a linear solver.
_HASHED = tuple(table for table in VERSIONED if table not in {frames, placements})
_LEFT_OUT = {"key", "checksum"}
# Tables that count only if they hold rows.
_IF_ANY = {"amendments", "anchors", "goals", "omitted_landmarks", "removals"}

Identities = dict[str, dict[int, Any]]


def content_hash(connection: Connection, at: int) -> str:
    """Hash of all rows of the committed revisions up to `at`, 32 hexadecimal digits.

    Rows are hashed in canonical order, with UUIDs and revision numbers in place of keys, without
    the time and host of writing.

    Raises:
        MapCorruptError: a row is damaged or points at nothing.
    """
    view = View(at)
    digest = hashlib.sha256(_history(connection, view))
    for name, rows in _canonical(connection, view).items():
        if not rows and name in _IF_ANY:
            continue
        for part in _parts(name, rows):
            digest.update(part)
    return digest.hexdigest()[:32]


def record_hashes(connection: Connection, at: int) -> dict[str, str]:
    """Hash of each table that has rows, by its name, 16 hexadecimal digits.

    Covers the same as `content_hash` except for authors, messages, versions and configurations of
    revisions.

    Raises:
        MapCorruptError: a row is damaged or points at nothing.
    """
    found = {}
    for name, rows in _canonical(connection, View(at)).items():
        if rows:
            digest = hashlib.sha256()
            for part in _parts(name, rows):
                digest.update(part)
            found[name] = digest.hexdigest()[:16]
    return found


def _canonical(connection: Connection, view: View) -> dict[str, list[bytes]]:
    """The rows of each table in canonical order; one for all attempts of a session."""
    identities = _identities(connection, view)
    by_key = {
        str(table.name): _canonical_rows(connection, view, table, identities)
        for table in _HASHED
        if table is not hidden
    }
    by_key[str(hidden.name)] = _hidden_rows(connection, view, identities, by_key)
    return {name: sorted(set(rows.values())) for name, rows in by_key.items()}


def _parts(name: str, rows: list[bytes]) -> Iterator[bytes]:
    yield _encode([name, len(rows)])
    yield from rows


def _history(connection: Connection, view: View) -> bytes:
    query = (
        select(revisions)
        .where(revisions.c.key.in_(view.revision_keys()))
        .order_by(revisions.c.number)
    )
    told = ("number", "parent", "author", "message", "tool_version", "configuration")
    rows = verified(revisions, connection.execute(query))
    return _encode([[row[name] for name in told] for row in rows])


def _identities(connection: Connection, view: View) -> Identities:
    """Identity of each row, equal in equal maps, by table and key."""
    numbers = select(revisions.c.key, revisions.c.number).where(
        revisions.c.key.in_(view.revision_keys())
    )
    found: Identities = {
        "revisions": {row[0]: row[1] for row in connection.execute(numbers)},
        "cameras": {key: camera.id for key, camera in load_cameras(connection).items()},
        "frontends": {
            key: [str(descriptor), digest]
            for key, (descriptor, digest) in load_frontends(connection).items()
        },
    }
    for table in (sessions, nodes, paths):
        uuids = select(table.c.key, table.c.uuid).order_by(table.c.key)
        found[str(table.name)] = {row[0]: row[1] for row in connection.execute(uuids)}
    return found


def _canonical_rows(
    connection: Connection, view: View, table: Table, identities: Identities
) -> dict[int, bytes]:
    """One byte string per row, by key; the same for all attempts of a revision and session."""
    query = (
        select(table)
        .where(table.c.revision.in_(view.revision_keys()))
        .order_by(*table.primary_key.columns)
    )
    found = connection.execute(query)
    if table is attempts:
        return _canonical_attempts(list(verified(table, found)), identities)
    # Tens of thousands of rows: what is the same for all of them is looked up once.
    columns = [
        (at, _REFERENCES.get(column.name))
        for at, column in enumerate(table.columns)
        if column.name not in _LEFT_OUT
    ]
    key = [column.name for column in table.columns].index("key")
    return {
        row[key]: _encode(
            [
                row[at] if other is None else _identity(identities, other, row[at])
                for at, other in columns
            ]
        )
        for row in verified_values(table, found)
    }


def _canonical_attempts(rows: list[Row], identities: Identities) -> dict[int, bytes]:
    """Attempts, independent of their packing."""
    packed: dict[tuple[int, int], list[Row]] = {}
    for row in rows:
        packed.setdefault((row["revision"], row["session"]), []).append(row)
    found: dict[int, bytes] = {}
    for (revision, session), bodies in packed.items():
        table = Attempts.joined([unpack(row["body"], row["count"]) for row in bodies])
        content = _encode(
            [
                _identity(identities, "revisions", revision),
                _identity(identities, "sessions", session),
                list(table.policies),
                table.policy.astype("<i4").tobytes(),
                *(_column_bytes(table, name, identities) for name in COLUMNS),
            ]
        )
        found.update((row["key"], content) for row in bodies)
    return found


def _column_bytes(table: Attempts, name: str, identities: Identities) -> bytes:
    values: NDArray[np.generic] = getattr(table, name)
    if name in {"reference", "node"}:
        keys, index = np.unique(values, return_inverse=True)
        uuids = [_identity(identities, "nodes", int(key)) for key in keys]
        return b"".join(uuids[at] for at in index)
    return values.astype(values.dtype.newbyteorder("<")).tobytes()


def _hidden_rows(
    connection: Connection,
    view: View,
    identities: Identities,
    canonical: dict[str, dict[int, bytes]],
) -> dict[int, bytes]:
    query = select(hidden).where(hidden.c.revision.in_(view.revision_keys())).order_by(hidden.c.key)
    found = {}
    for row in verified(hidden, connection.execute(query)):
        if row["record"] == placements.name:
            continue
        target = canonical.get(row["record"], {}).get(row["target"])
        if target is None:
            raise MapCorruptError(f"table hidden: row {row['key']} hides a row that is missing")
        revision = _identity(identities, "revisions", row["revision"])
        found[row["key"]] = _encode([revision, row["record"], target, row["hidden"]])
    return found


def _identity(identities: Identities, table: str, key: int) -> Any:
    try:
        return identities[table][key]
    except KeyError:
        raise MapCorruptError(f"table {table}: row {key}, which others use, is missing") from None
