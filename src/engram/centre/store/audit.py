"""The audit log: every change of state, each row bound to the one before by a hash.

It is the stream of events as well.
"""

from __future__ import annotations

import hashlib
import json
import logging
from typing import Any

from sqlalchemy import Connection, Select, insert, select

from engram.centre.store.database import rows_of
from engram.centre.store.schema import audit, subjects

_log = logging.getLogger(__name__)


def note(
    connection: Connection, at_ns: int, subject: str, action: str, name: str, /, **detail: Any
) -> None:
    """Adds a row; call it in the transaction that changes the state.

    Args:
        connection: in a writing transaction.
        at_ns: the time.
        subject: who did it.
        action: what.
        name: of the map; "" for none.
        **detail: plain data.
    """
    newest = select(audit.c.number, audit.c.hash).order_by(audit.c.number.desc()).limit(1)
    last, before = connection.execute(newest).first() or (0, "")
    row = {
        "number": last + 1,
        "at_ns": at_ns,
        "subject": subject,
        "action": action,
        "map": name,
        "detail": json.dumps(detail, sort_keys=True),
    }
    connection.execute(insert(audit).values(**row, hash=_hash(before, row)))
    if _log.isEnabledFor(logging.INFO):
        known = connection.execute(select(subjects.c.name).where(subjects.c.id == subject)).scalar()
        told = "".join(f" {key}={value}" for key, value in detail.items())
        _log.info("%s: %s by %s%s", name or "centre", action, known or subject, told)


def events_after(
    connection: Connection, number: int, name: str | None, limit: int
) -> list[dict[str, Any]]:
    """The next rows after a number, of one map or of all."""
    query = select(audit).where(audit.c.number > number).order_by(audit.c.number).limit(limit)
    if name is not None:
        query = query.where(audit.c.map == name)
    return _events(connection, query)


def newest_events(connection: Connection, name: str, limit: int) -> list[dict[str, Any]]:
    """The last rows of one map, newest first."""
    query = select(audit).where(audit.c.map == name).order_by(audit.c.number.desc()).limit(limit)
    return _events(connection, query)


def _events(connection: Connection, query: Select[Any]) -> list[dict[str, Any]]:
    rows = rows_of(connection, query)
    return [{**row, "detail": json.loads(row["detail"])} for row in rows]


def first_broken(connection: Connection) -> int | None:
    """Number of the first row that was changed, removed or added later; None for a whole log."""
    before = ""
    query = select(audit).order_by(audit.c.number).execution_options(yield_per=1000)
    for number, row in enumerate(map(dict, connection.execute(query).mappings()), 1):
        told = row.pop("hash")
        if row["number"] != number or told != _hash(before, row):
            return number
        before = told
    return None


def _hash(before: str, row: dict[str, Any]) -> str:
    return hashlib.sha256((before + json.dumps(row, sort_keys=True)).encode()).hexdigest()
