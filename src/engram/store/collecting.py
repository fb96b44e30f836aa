"""Rows of abandoned revisions: invisible to all, removed when somebody asks for it."""

from __future__ import annotations

from sqlalchemy import Connection, delete, func, select

from engram.store.schema import VERSIONED, revisions


def count_abandoned(connection: Connection) -> int:
    """How many rows of abandoned revisions are still in the file."""
    return sum(
        connection.execute(
            select(func.count()).select_from(table).where(table.c.revision.in_(_ABANDONED))
        ).scalar_one()
        for table in VERSIONED
    )


def collect_abandoned(connection: Connection) -> int:
    """Remove them; returns how many there were. The revisions themselves stay on record."""
    return sum(
        connection.execute(delete(table).where(table.c.revision.in_(_ABANDONED))).rowcount
        for table in reversed(VERSIONED)
    )


_ABANDONED = select(revisions.c.key).where(revisions.c.status == "abandoned")
