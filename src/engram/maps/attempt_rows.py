"""Remembered attempts on their way into rows: packed, per revision and session."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sqlalchemy import Connection, delete, insert, select

from engram.graph.model import Attempt
from engram.maps.attempts import COLUMNS, AttemptTable, concatenate, pack, unpack
from engram.maps.keys import KeyBook
from engram.maps.rows import sealed, verified
from engram.maps.schema import attempts


def repack_attempts(connection: Connection, keys: KeyBook, revision_key: int) -> None:
    """Pack the attempts of all checkpoints together: the file does not tell when they were made."""
    query = select(attempts).where(attempts.c.revision == revision_key).order_by(attempts.c.key)
    by_session: dict[int, list[AttemptTable]] = {}
    for row in verified(attempts, connection.execute(query)):
        by_session.setdefault(row["session"], []).append(unpack(row["body"], row["count"]))
    if by_session:
        connection.execute(delete(attempts).where(attempts.c.revision == revision_key))
    for session_key, tables in by_session.items():
        write_attempts(connection, keys, revision_key, session_key, concatenate(tables))


def write_attempts(
    connection: Connection, keys: KeyBook, revision_key: int, session_key: int, table: AttemptTable
) -> None:
    """Insert a session's attempts, packed."""
    rows = [
        sealed(
            attempts,
            {
                "key": keys.next(attempts),
                "revision": revision_key,
                "session": session_key,
                "count": count,
                "body": body,
            },
        )
        for count, body in pack(table)
    ]
    connection.execute(insert(attempts), rows)


def attempt_table(made: Sequence[Attempt], keys: Sequence[tuple[int, int]]) -> AttemptTable:
    """Records as columns.

    Args:
        made: attempts of one session.
        keys: for each the keys of its reference and of the attempted node.
    """
    policies = tuple(dict.fromkeys(one.policy for one in made))
    index = {name: at for at, name in enumerate(policies)}
    ends = dict(zip(("reference", "node"), zip(*keys, strict=True), strict=True))
    columns = {
        name: np.array(ends[name] if name in ends else [getattr(one, name) for one in made], kind)
        for name, kind in COLUMNS
    }
    policy = np.array([index[one.policy] for one in made], np.int32)
    return AttemptTable(columns, policy, policies)
