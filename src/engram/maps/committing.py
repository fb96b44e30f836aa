"""How a revision becomes part of a map, and what is said about it for ever."""

from __future__ import annotations

import time
from typing import Any

from sqlalchemy import Connection, func, select, update

from engram.errors import RevisionError
from engram.graph.model import EdgeKind
from engram.maps.reading import log
from engram.maps.records import Revision, RevisionStatus
from engram.maps.rows import sealed, to_json, transform_from_bytes, verified
from engram.maps.schema import VERSIONED, attempts, edges, revisions
from engram.maps.view import View, head


def commit_revision(
    connection: Connection,
    revision_key: int,
    *,
    was: RevisionStatus = RevisionStatus.OPEN,
    contents: dict[str, float] | None = None,
    committed_ns: int | None = None,
) -> Revision:
    """Flip a revision to committed and give it its number.

    Args:
        connection: of the transaction that this shall be part of.
        revision_key: its row.
        was: the status that it was written under.
        contents: of `revision_contents`, where they were counted before; None counts here.
        committed_ns: when, UTC; None for now.

    Raises:
        RevisionError: it has another status.
    """
    parent = head(connection)
    if contents is None:
        contents = revision_contents(connection, revision_key)
    change_revision(
        connection,
        revision_key,
        was=was,
        status=str(RevisionStatus.COMMITTED),
        number=parent + 1,
        parent=parent or None,
        committed_ns=time.time_ns() if committed_ns is None else committed_ns,
        contents=to_json(contents),
    )
    return log(connection, View(parent + 1))[-1]


def change_revision(
    connection: Connection, key: int, *, was: RevisionStatus = RevisionStatus.OPEN, **changes: Any
) -> None:
    """Change the row of a revision that is not committed.

    Raises:
        RevisionError: it has another status than `was`.
    """
    found = connection.execute(select(revisions).where(revisions.c.key == key))
    row = next(verified(revisions, found), None)
    if row is None or row["status"] != was:
        raise RevisionError(f"revision row {key} is not {was}")
    row = sealed(revisions, {**row, **changes})
    connection.execute(update(revisions).where(revisions.c.key == key).values(row))


def revision_contents(connection: Connection, revision_key: int) -> dict[str, float]:
    """How many rows of each table a revision brought, and metres of odometry edges."""
    contents: dict[str, float] = {}
    for table in VERSIONED:
        rows = select(func.count()).select_from(table).where(table.c.revision == revision_key)
        contents[table.name] = connection.execute(rows).scalar_one()
    packed = select(func.sum(attempts.c.count)).where(attempts.c.revision == revision_key)
    contents["attempts"] = int(connection.execute(packed).scalar() or 0)
    steps = (
        select(edges.c.a_from_b)
        .where(edges.c.revision == revision_key, edges.c.kind == str(EdgeKind.ODOMETRY))
        .order_by(edges.c.key)
    )
    contents["mapped_m"] = sum(
        transform_from_bytes(step, "odometry edge").distance_m
        for step in connection.execute(steps).scalars()
    )
    return contents
