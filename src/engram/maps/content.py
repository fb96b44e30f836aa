"""The content hash: equal for equal maps, independent of place and time (method §7.5).

That of a revision is made of the one before and of what the revision adds, so that a commit hashes
its own rows alone. A row counts by its digest, which a receipt keeps when the row is erased.
"""

from __future__ import annotations

import hashlib
import re
from collections import defaultdict
from collections.abc import Collection, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, Connection, Table, select

from engram.errors import MapCorruptError
from engram.graph.paths import Attempts
from engram.maps.attempts import COLUMNS, unpack_drive
from engram.maps.reading import load_cameras, load_frontends
from engram.maps.rows import Row, verified, verified_values
from engram.maps.schema import (
    VERSIONED,
    attempts,
    frames,
    hidden,
    metadata,
    nodes,
    paths,
    placements,
    receipts,
    revisions,
    sessions,
)
from engram.maps.totals import Own, own_rows
from engram.maps.view import View, few

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
_HIDDEN = {*VERSIONED} - {hidden, placements}
_LEFT_OUT = {"key", "checksum"}
_NAMED_BY_UUID = (sessions, nodes, paths)
_ANY_RECEIPT = "SELECT EXISTS (SELECT 1 FROM receipts)"
# UUIDs of a table that are kept from one revision to the next.
_MOST = 100_000
_HISTORY = ("number", "parent", "author", "message", "tool_version", "configuration")


def content_hash(connection: Connection, at: int) -> str:
    """Hash of all committed revisions up to `at`, 32 hexadecimal digits, as stored.

    Rows are hashed in canonical order, with UUIDs and revision numbers in place of keys, without
    the time and host of writing.

    Raises:
        MapCorruptError: the row of the revision is damaged.
    """
    if at == 0:
        return EMPTY_HASH
    query = select(revisions).where(revisions.c.number == at)
    found = str(next(verified(revisions, connection.execute(query)))["chain"])
    if not re.fullmatch("[0-9a-f]{32}", found):
        raise MapCorruptError(f"revision {at}: {found!r:.40} is not a content hash")
    return found


def verified_hash(connection: Connection, at: int, since: int = 0) -> str:
    """`content_hash`, worked out again from all rows; or from those after a revision.

    Raises:
        MapCorruptError: a row is damaged or points at nothing, or a stored hash is another.
    """
    known, found = Identities(connection), content_hash(connection, since)
    query = select(revisions).where(revisions.c.number > since, revisions.c.number <= at)
    query = query.order_by(revisions.c.number)
    for row in list(verified(revisions, connection.execute(query))):
        found = chained(connection, found, row, own_rows(row), known)
        if found != row["chain"]:
            raise MapCorruptError(
                f"revision {row['number']}: its rows have the content hash {found}, not "
                f"{row['chain']!r:.40}"
            )
    return found


def chained(
    connection: Connection, before: str, row: Row, own: Own, known: Identities | None = None
) -> str:
    """The content hash as of a revision.

    Args:
        connection: of the map.
        before: the content hash as of the one before.
        row: of the revision, with its number.
        own: its rows.
        known: what is known of other rows; None for nothing yet.

    Raises:
        MapCorruptError: a row is damaged or points at nothing.
    """
    known = known or Identities(connection)
    known.forget_many()
    known.add_revision(row["key"], row["number"])
    digest = hashlib.sha256(bytes.fromhex(before))
    digest.update(_encode([row[name] for name in _HISTORY]))
    for table in _HASHED:
        if table.name in own.ranges:
            rows = _digests(connection, table, own.rows(table), known)
            erased = _erased(connection, own.erased(table)) if known.have_gone else {}
            digest.update(_table_bytes(table, {*rows.values(), *erased.values()}))
    return digest.hexdigest()[:32]


# Of a map before its first revision.
EMPTY_HASH = hashlib.sha256(b"").hexdigest()[:32]


def record_hashes(connection: Connection, at: int) -> dict[str, str]:
    """Hash of each table that has rows, by its name, 16 hexadecimal digits.

    Covers the same as `content_hash` except for authors, messages, versions and configurations of
    revisions.

    Raises:
        MapCorruptError: a row is damaged or points at nothing.
    """
    found = {}
    known, seen = Identities(connection), View(at).revision_keys()
    for table in _HASHED:
        of_table = (receipts.c.record == table.name) & receipts.c.revision.in_(seen)
        rows = {
            *_digests(connection, table, table.c.revision.in_(seen), known).values(),
            *_erased(connection, of_table).values(),
        }
        if rows:
            digest = hashlib.sha256(_table_bytes(table, rows))
            found[str(table.name)] = digest.hexdigest()[:16]
    return found


def _table_bytes(table: Table, digests: set[bytes]) -> bytes:
    """What rows of a table add to a hash, given by their digests."""
    return _encode([str(table.name), len(digests)]) + b"".join(sorted(digests))


def row_digests(
    connection: Connection, table: Table, keys: Collection[int], known: Identities
) -> dict[int, bytes | None]:
    """What stands for rows in the content hash, by key; None for a table that is not in it.

    Raises:
        MapCorruptError: a row is damaged or points at nothing.
    """
    if table not in _HASHED:
        return dict.fromkeys(keys)
    found = _target_digests(connection, table, keys, known)
    return {key: found[key] for key in keys}


def _erased(connection: Connection, which: ColumnElement[bool]) -> dict[int, bytes]:
    """Digests of erased rows by the keys that they had, of receipts."""
    query = select(receipts).where(which).order_by(receipts.c.key)
    found = verified(receipts, connection.execute(query))
    return {row["target"]: row["digest"] for row in found if row["digest"] is not None}


class Identities:
    """What names a row in all equal maps, by table and key; read when first needed.

    Attributes:
        have_gone: whether the map has erased rows.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self.have_gone = bool(connection.exec_driver_sql(_ANY_RECEIPT).scalar())
        numbers = select(revisions.c.key, revisions.c.number).where(revisions.c.number.is_not(None))
        self._known: dict[str, dict[int, Any]] = {
            "revisions": {row[0]: row[1] for row in connection.execute(numbers)},
            "cameras": {key: camera.id for key, camera in load_cameras(connection).items()},
            "frontends": {
                key: [str(descriptor), digest]
                for key, (descriptor, digest) in load_frontends(connection).items()
            },
            **{str(table.name): {} for table in _NAMED_BY_UUID},
        }

    def add_revision(self, key: int, number: int) -> None:
        """Adds the revision that is being committed."""
        self._known["revisions"][key] = number

    def forget_many(self) -> None:
        """Forgets rows if there are so many of them that they are better read again."""
        for table in _NAMED_BY_UUID:
            if len(self._known[table.name]) > _MOST:
                self._known[table.name].clear()

    def learn(self, table: Table, rows: Sequence[Sequence[Any]]) -> None:
        """Adds rows of a table that were read."""
        if table.name in self._known and "uuid" in table.c:
            key, uuid = (table.columns.keys().index(name) for name in ("key", "uuid"))
            self._known[table.name].update((row[key], row[uuid]) for row in rows)

    def of(self, table: str, keys: Collection[int]) -> dict[int, Any]:
        """Those of at least these keys of a table.

        Raises:
            MapCorruptError: there is no such row.
        """
        known = self._known[table]
        wanted = sorted(set(keys) - known.keys())
        uuids = metadata.tables[table]
        for part in few(wanted) if "uuid" in uuids.c else ():
            query = select(uuids.c.key, uuids.c.uuid).where(uuids.c.key.in_(part))
            known.update(map(tuple, self._connection.execute(query)))
            if erased := [key for key in part if key not in known]:
                of_table = (receipts.c.record == table) & receipts.c.target.in_(erased)
                query = select(receipts.c.target, receipts.c.uuid).where(of_table)
                known.update(map(tuple, self._connection.execute(query)))
        missing = [key for key in wanted if key not in known]
        if missing:
            raise MapCorruptError(f"table {table}: row {missing[0]}, which others use, is missing")
        return known


def _digests(
    connection: Connection, table: Table, which: ColumnElement[bool], known: Identities
) -> dict[int, bytes]:
    """16 bytes for each row, by key; the same for all attempts of a revision and session."""
    query = select(table).where(which).order_by(*table.primary_key.columns)
    found = connection.execute(query)
    if table is attempts:
        return _attempt_digests(list(verified(table, found)), known)
    if table is hidden:
        return _hidden_digests(connection, list(verified(table, found)), known)
    rows = list(verified_values(table, found))
    known.learn(table, rows)
    names = [column.name for column in table.columns]
    # Tens of thousands of rows: what is the same for all of them is looked up once.
    columns = [
        (at, None if (other := _REFERENCES.get(name)) is None else known.of(other, _at(rows, at)))
        for at, name in enumerate(names)
        if name not in _LEFT_OUT
    ]
    key = names.index("key")
    return {
        row[key]: _digest([row[at] if named is None else named[row[at]] for at, named in columns])
        for row in rows
    }


def _digest(canonical: list[Any]) -> bytes:
    return hashlib.sha256(_encode(canonical)).digest()[:16]


def _at(rows: list[Any], at: int) -> set[int]:
    return {row[at] for row in rows}


def _attempt_digests(rows: list[Row], known: Identities) -> dict[int, bytes]:
    """Of attempts, independent of their packing."""
    packed: dict[tuple[int, int], list[Row]] = {}
    for row in rows:
        packed.setdefault((row["revision"], row["session"]), []).append(row)
    found: dict[int, bytes] = {}
    for (revision, session), bodies in packed.items():
        table = unpack_drive(bodies)
        content = _digest(
            [
                known.of("revisions", [revision])[revision],
                known.of("sessions", [session])[session],
                list(table.policies),
                table.policy.astype("<i4").tobytes(),
                *(_column_bytes(table, name, known) for name in COLUMNS),
            ]
        )
        found.update((row["key"], content) for row in bodies)
    return found


def _column_bytes(table: Attempts, name: str, known: Identities) -> bytes:
    values: NDArray[np.generic] = getattr(table, name)
    if name in {"reference", "node"}:
        keys, index = np.unique(values, return_inverse=True)
        named = known.of("nodes", keys.tolist())
        uuids = [named[int(key)] for key in keys]
        return b"".join(uuids[at] for at in index)
    return values.astype(values.dtype.newbyteorder("<")).tobytes()


def _hidden_digests(connection: Connection, rows: list[Row], known: Identities) -> dict[int, bytes]:
    """Of rows that hide others, each with the row that it hides."""
    targets: dict[str, set[int]] = defaultdict(set)
    for row in rows:
        if row["record"] != placements.name:
            targets[row["record"]].add(row["target"])
    named = {
        name: _target_digests(connection, metadata.tables[name], keys, known)
        for name, keys in targets.items()
        if metadata.tables.get(name) in _HIDDEN
    }
    found = {}
    for row in rows:
        if row["record"] == placements.name:
            continue
        target = named.get(row["record"], {}).get(row["target"])
        if target is None:
            raise MapCorruptError(f"table hidden: row {row['key']} hides a row that is missing")
        number = known.of("revisions", [row["revision"]])[row["revision"]]
        found[row["key"]] = _digest([number, row["record"], target, row["hidden"]])
    return found


def _target_digests(
    connection: Connection, table: Table, keys: Collection[int], known: Identities
) -> dict[int, bytes]:
    """Of the rows of these keys; of attempts, with all others of their revision and session.

    A picture, which is hidden as a row of `frames`, goes by the UUID of its node.
    """
    if table is frames:
        return known.of(nodes.name, keys)
    found: dict[int, bytes] = {}
    for part in few(sorted(keys)):
        which = table.c.key.in_(part)
        if table is attempts:
            pairs = select(attempts.c.session, attempts.c.revision).where(which).distinct()
            for session, revision in connection.execute(pairs).fetchall():
                both = (attempts.c.session == session) & (attempts.c.revision == revision)
                found |= _digests(connection, table, both, known)
        else:
            found |= _digests(connection, table, which, known)
        if erased := [key for key in part if key not in found]:
            of_table = (receipts.c.record == table.name) & receipts.c.target.in_(erased)
            found |= _erased(connection, of_table)
    return found
