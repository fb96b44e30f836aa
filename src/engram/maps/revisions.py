"""States of revisions (committed, abandoned, collected) and of the sessions in open ones."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

from sqlalchemy import Connection, Table, bindparam, delete, func, select, update

from engram import __version__
from engram.errors import MapCorruptError, RevisionError
from engram.files import Holder
from engram.graph.model import EdgeKind, PathEntry, PathEntryKind, SessionId, path_id
from engram.maps import reading
from engram.maps.content import chained, content_hash
from engram.maps.counting import count_open
from engram.maps.records import InterruptedSession, Revision, RevisionStatus, StoredSession
from engram.maps.rows import (
    Row,
    checked_text,
    from_json,
    node_from_bytes,
    node_from_row,
    sealed,
    session_from_row,
    to_json,
    transform_from_bytes,
    verified,
)
from engram.maps.runs import save_runs
from engram.maps.schema import (
    VERSIONED,
    attempts,
    edges,
    hidden,
    nodes,
    path_entries,
    paths,
    revisions,
    sessions,
    words,
)
from engram.maps.totals import Own, own_rows
from engram.maps.view import LARGEST_KEY, KeyBook, View, head, place_in_history

# Number, first and last key of the rows of a revision, of one table after another: as text, since
# building 17 statements takes ten times as long as answering them.
_COUNTED = " UNION ALL ".join(
    f"SELECT count(*), min({key}), max({key}) FROM {table.name} "
    f"WHERE {key} BETWEEN ? AND ? AND revision = ?"
    for table in VERSIONED
    for key in [table.primary_key.columns[0].name]
)
_CHANGED = update(revisions).where(revisions.c.key == bindparam("which"))
# Ranges of a revision without rows.
_NOTHING = to_json({})


def new_revision(
    keys: KeyBook, writer: Holder, author: str, message: str, configuration: Mapping[str, Any]
) -> Row:
    """The row of a revision that begins."""
    return {
        "key": keys.next(revisions),
        "number": None,
        "status": str(RevisionStatus.ABANDONED),  # until it has something to keep
        "parent": None,
        "author": checked_text(author, "author"),
        "message": checked_text(message, "message"),
        "tool_version": __version__,
        "configuration": to_json(configuration),
        "contents": "{}",
        "opened_ns": time.time_ns(),
        "committed_ns": None,
        "host": writer.host,
        "pid": writer.pid,
        "writer": writer.token,
        "ranges": to_json(
            {name: (first, LARGEST_KEY) for name, first in keys.first_keys(VERSIONED).items()}
        ),
        "totals": "{}",
        "chain": "",
    }


def commit_revision(
    connection: Connection,
    row: Row,
    contents: Mapping[str, float],
    own: Own,
    committed_ns: int | None = None,
) -> Revision:
    """Commits a revision and gives it its number.

    Args:
        connection: in a transaction that includes this step.
        row: its row.
        contents, own: what it has `brought`.
        committed_ns: when, UTC; None for now.
    """
    parent = head(connection)
    totals, after, before = count_open(connection, View(parent, own.key), own)
    save_runs(connection, before, after)
    row = row | {
        "status": str(RevisionStatus.COMMITTED),
        "number": parent + 1,
        "parent": parent or None,
        "committed_ns": time.time_ns() if committed_ns is None else committed_ns,
        "contents": to_json(contents),
        "ranges": to_json(own.ranges),
        "totals": totals.to_json(),
    }
    row["chain"] = chained(connection, content_hash(connection, parent), row, own)
    _put(connection, row)
    return reading.revision_from_row(row)


def revision_row(connection: Connection, key: int, status: RevisionStatus) -> Row:
    """The row of a revision.

    Raises:
        RevisionError: it has another status.
    """
    found = connection.execute(select(revisions).where(revisions.c.key == key))
    row = next(verified(revisions, found), None)
    if row is None or row["status"] != status:
        raise RevisionError(f"revision row {key} is not {status}")
    return row


def _put(connection: Connection, row: Row) -> None:
    connection.execute(_CHANGED, sealed(revisions, row) | {"which": row["key"]})


def change_revision(
    connection: Connection, key: int, *, was: RevisionStatus = RevisionStatus.OPEN, **changes: Any
) -> None:
    """Changes the row of an uncommitted revision.

    Raises:
        RevisionError: it has another status than `was`.
    """
    _put(connection, revision_row(connection, key, was) | changes)


def brought(connection: Connection, row: Row) -> tuple[dict[str, float], Own]:
    """What a revision adds, given by its row.

    Returns:
        The number of its rows by table, and metres of odometry edges; and its rows, within the
        least ranges of keys.
    """
    own = own_rows(row)
    contents: dict[str, float] = {}
    ranges: dict[str, tuple[int, int]] = {}
    within = [(*own.ranges.get(table.name, (0, -1)), own.key) for table in VERSIONED]
    counted = connection.exec_driver_sql(_COUNTED, tuple(chain.from_iterable(within)))
    for table, (count, first, last) in zip(VERSIONED, counted, strict=True):
        contents[table.name] = count
        if count:
            ranges[table.name] = (first, last)
    packed = select(func.sum(attempts.c.count)).where(own.rows(attempts))
    contents["attempts"] = int(connection.execute(packed).scalar() or 0)
    steps = (
        select(edges.c.a_from_b)
        .where(own.rows(edges), edges.c.kind == str(EdgeKind.ODOMETRY))
        .order_by(edges.c.key)
    )
    contents["mapped_m"] = sum(
        transform_from_bytes(step, "odometry edge").distance_m
        for step in connection.execute(steps).scalars()
    )
    return contents, Own(own.key, ranges)


def with_rows(
    contents: Mapping[str, float], own: Own, table: Table, rows: Sequence[Row]
) -> tuple[dict[str, float], Own]:
    """What a revision has `brought` with these rows of a table, which have the newest keys."""
    if not rows:
        return dict(contents), own
    first, _ = own.ranges.get(table.name, (rows[0]["key"], 0))
    ranges = {**own.ranges, table.name: (first, rows[-1]["key"])}
    more = contents[table.name] + len(rows)
    return {**contents, table.name: more}, Own(own.key, ranges)


def changes_layout(contents: Mapping[str, float]) -> bool:
    """Whether a revision of these contents may change where nodes lie in the map frame."""
    unplaced = contents["nodes"] > contents["placements"]
    joins = contents["edges"] and not contents["placements"]
    return bool(unplaced or joins or contents["removals"])


def collect_abandoned(connection: Connection) -> int:
    """Removes the rows of abandoned revisions, but not their records; returns the number."""
    query = select(revisions).where(
        revisions.c.status == str(RevisionStatus.ABANDONED), revisions.c.ranges != _NOTHING
    )
    found = 0
    for row in list(verified(revisions, connection.execute(query.order_by(revisions.c.key)))):
        own = own_rows(row)
        lost = select(nodes.c.key).where(own.rows(nodes))
        connection.execute(delete(words).where(words.c.node.in_(lost)))  # keys may be reused
        found += sum(
            connection.execute(delete(table).where(own.rows(table))).rowcount
            for table in reversed(VERSIONED)
        )
        _put(connection, row | {"ranges": _NOTHING})
    return found


def settled_nodes(connection: Connection) -> int:
    """Largest key of a node below which no row can be collected.

    The keys of an open or abandoned revision may be used again.
    """
    last = connection.execute(select(func.max(nodes.c.key))).scalar() or 0
    query = select(revisions).where(revisions.c.status != str(RevisionStatus.COMMITTED))
    for row in verified(revisions, connection.execute(query)):
        first, _ = own_rows(row).ranges.get(nodes.name, (last + 1, 0))
        last = min(last, first - 1)
    return last


def session_and_revision(
    connection: Connection, session: SessionId, at: int
) -> tuple[Row, Row] | None:
    """Rows of a session and of the revision that last added it or showed it again.

    None if the map never had it, or if it is hidden as of revision `at`. The revision may have any
    status.
    """
    query = select(sessions).where(sessions.c.uuid == session.bytes).order_by(sessions.c.key)
    row = next(verified(sessions, connection.execute(query)), None)
    if row is None:
        return None
    said = _last_word(connection, row["key"], at)
    if said is not None and said["hidden"]:
        return None
    by = row["revision"] if said is None else said["revision"]
    query = select(revisions).where(revisions.c.key == by).order_by(revisions.c.key)
    revision = next(verified(revisions, connection.execute(query)), None)
    if revision is None:
        raise MapCorruptError(f"session {session}: its revision is missing; run engram check")
    return row, revision


def _last_word(connection: Connection, session_key: int, at: int) -> Row | None:
    """The newest `hidden` row for a session, of open revisions or committed ones up to `at`."""
    place = place_in_history()
    query = (
        select(*hidden.columns)
        .join(revisions, revisions.c.key == hidden.c.revision)
        .where(hidden.c.record == sessions.name, hidden.c.target == session_key)
        .where(
            (revisions.c.status == str(RevisionStatus.OPEN))
            | ((revisions.c.status == str(RevisionStatus.COMMITTED)) & (revisions.c.number <= at))
        )
        .order_by(place.desc(), hidden.c.key.desc())
        .limit(1)
    )
    return next(verified(hidden, connection.execute(query)), None)


def sessions_of(connection: Connection, revision_key: int) -> list[Row]:
    """The sessions that a revision added or showed again, oldest key first."""
    shown = select(hidden.c.target).where(
        hidden.c.record == sessions.name,
        hidden.c.hidden == 0,
        hidden.c.revision == revision_key,
    )
    query = (
        select(sessions)
        .where((sessions.c.revision == revision_key) | sessions.c.key.in_(shown))
        .order_by(sessions.c.key)
    )
    return list(verified(sessions, connection.execute(query)))


def open_sessions(connection: Connection) -> frozenset[bytes]:
    """UUIDs of the sessions that are neither committed nor abandoned."""
    query = select(revisions.c.key).where(revisions.c.status == str(RevisionStatus.OPEN))
    keys = connection.execute(query.order_by(revisions.c.key)).scalars().all()
    return frozenset(row["uuid"] for key in keys for row in sessions_of(connection, key))


def interrupted_sessions(
    connection: Connection, revision: Row, at: int
) -> list[InterruptedSession]:
    """The session of an open revision; none for a revision of another kind."""
    cameras = reading.load_cameras(connection)
    about = from_json(revision["configuration"], f"revision row {revision['key']}")
    live = about.get("live") is True
    found = []
    for row in sessions_of(connection, revision["key"]):
        session = session_from_row(row, cameras[row["camera"]].id)
        stored = stored_session(connection, View(at, revision["key"]), row)
        found.append(
            InterruptedSession(
                session=session,
                author=revision["author"],
                host=revision["host"],
                pid=revision["pid"],
                opened_ns=revision["opened_ns"],
                nodes=len(stored.nodes),
                last_stamp_ns=max((node.stamp_ns for node in stored.nodes), default=None),
                live=live,
            )
        )
    return found


def stored_session(connection: Connection, view: View, session: Row) -> StoredSession:
    """The checkpointed part of an open session, in its own view."""
    cameras = reading.load_cameras(connection)
    session_id = session_from_row(session, cameras[session["camera"]].id).id
    query = view.select(nodes).where(nodes.c.session == session["key"])
    saved = sorted(
        (
            node_from_row(row, session_id, cameras[row["camera"]].id)
            for row in verified(nodes, connection.execute(query))
        ),
        key=lambda node: node.stamp_ns,
    )
    last_entry = _last_path_entry(connection, view, session["key"], session_id)
    made = reading.attempt_tables(connection, view, session["key"]).get(session["key"])
    return StoredSession(
        nodes=tuple(saved),
        last_entry=last_entry,
        next_sequence=0 if last_entry is None else last_entry.sequence + 1,
        next_iteration=0 if made is None else int(made.iteration.max()) + 1,
        attempts=0 if made is None else len(made),
    )


def _last_path_entry(
    connection: Connection, view: View, session_key: int, session: SessionId
) -> PathEntry | None:
    owned = select(paths.c.key).where(paths.c.session == session_key)
    query = view.select(path_entries).where(path_entries.c.path.in_(owned))
    query = query.order_by(None).order_by(path_entries.c.sequence.desc()).limit(1)
    row = next(verified(path_entries, connection.execute(query)), None)
    if row is None:
        return None
    uuid = connection.execute(select(nodes.c.uuid).where(nodes.c.key == row["node"])).scalar_one()
    return PathEntry(
        path_id(session),
        row["sequence"],
        node_from_bytes(uuid),
        PathEntryKind(row["kind"]),
        row["stamp_ns"],
    )
