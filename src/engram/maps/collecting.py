"""Rows of abandoned revisions: invisible to all, removed when somebody asks for it."""

from __future__ import annotations

from sqlalchemy import Connection, delete, select

from engram.maps.schema import VERSIONED, nodes, revisions, words


def collect_abandoned(connection: Connection) -> int:
    """Remove them; returns how many there were. The revisions themselves stay on record."""
    lost = select(nodes.c.key).where(nodes.c.revision.in_(_ABANDONED))
    connection.execute(delete(words).where(words.c.node.in_(lost)))  # keys may be given out again
    return sum(
        connection.execute(delete(table).where(table.c.revision.in_(_ABANDONED))).rowcount
        for table in reversed(VERSIONED)
    )


_ABANDONED = select(revisions.c.key).where(revisions.c.status == "abandoned")
