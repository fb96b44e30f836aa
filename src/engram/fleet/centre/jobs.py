"""Jobs of a centre: hand-ins to merge, downloads to make, dreams. What all of them do.

The row of a job is the job; there is no other queue.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, TypeVar

from sqlalchemy import Connection, update

from engram.errors import InputError
from engram.fleet.centre.copies import Publication
from engram.fleet.centre.database import first_row, note, notify
from engram.fleet.centre.problems import UnknownError
from engram.fleet.centre.service import Centre
from engram.fleet.centre.tables import (
    ENDED,
    TABLES,
    Artifact,
    Dream,
    HandIn,
    JobState,
    artifacts,
    dreams,
    handins,
)

Job = TypeVar("Job", bound=HandIn | Artifact | Dream)
WORKER = "worker"
# In errors, in the audit log, and the order in which they are done.
_NOUNS: dict[type, str] = {HandIn: "hand-in", Artifact: "artifact", Dream: "dream"}
_LOGGED: dict[type, str] = {HandIn: "handin", Artifact: "artifact", Dream: "dream"}
_ORDER = {HandIn: handins.c.place, Artifact: artifacts.c.asked_ns, Dream: dreams.c.asked_ns}
_PENDING = (JobState.COMPLETE, JobState.ASKED)


def get(centre: Centre, kind: type[Job], key: str) -> Job:
    """A job by its id.

    Raises:
        UnknownError: there is none.
    """
    row = centre.database.row(kind, TABLES[kind].c.id == key)
    if row is None:
        raise UnknownError(f"there is no {_NOUNS[kind]} {key!r:.40}")
    return row


def named(centre: Centre, kind: type[Job], beginning: str) -> Job:
    """A job by its id, or enough of its beginning.

    Raises:
        UnknownError: no job has such an id.
        InputError: several jobs do.
    """
    begins = TABLES[kind].c.id.startswith(beginning, autoescape=True)
    found = centre.database.rows(kind, begins)
    if len(found) > 1:
        raise InputError(f"{len(found)} ids begin with {beginning!r:.40}: give more of it")
    return found[0] if found and beginning else get(centre, kind, beginning)


def pending(centre: Centre, kind: type[Job], name: str | None = None) -> list[Job]:
    """Jobs that wait for a worker or are in progress, first come first; of one map or of all."""
    table = TABLES[kind]
    of_map = () if name is None else (table.c.map == name,)
    return centre.database.rows(kind, table.c.state.in_(_PENDING), *of_map, order=_ORDER[kind])


def ask(
    centre: Centre,
    connection: Connection,
    row: HandIn | Artifact | Dream,
    by: str,
    action: str,
    *,
    again: Collection[JobState] = (),
    **detail: Any,
) -> None:
    """Adds a job. One that exists stays as it is, unless it is in one of the states `again`."""
    if not centre.database.add(connection, row):
        table = TABLES[type(row)]
        in_again = (table.c.id == row.id, table.c.state.in_(again))
        if first_row(connection, type(row), *in_again) is None:
            return
        centre.database.put(connection, row)
    note(connection, centre.now_ns(), by, action, row.map, **{_LOGGED[type(row)]: row.id}, **detail)
    if row.state in _PENDING:
        notify(connection)


def set_state(
    centre: Centre,
    row: Job,
    state: JobState,
    by: str = WORKER,
    action: str | None = None,
    made: Publication | None = None,
    **change: Any,
) -> Job:
    """Ends a job or opens it again, unless its state has changed since it was read.

    One transaction, with its event.

    Args:
        centre: the centre.
        row: the job as it was read.
        state: its new state.
        by: who changes it.
        action: name of the event; None for that of the state.
        made: what is published with it.
        **change: further columns.

    Returns:
        The job as it is now.

    Raises:
        StoreError: it cannot be published; nothing has changed.
    """
    kind = type(row)
    table, now = TABLES[kind], centre.now_ns()
    values = {"state": state, "ended_ns": now if state in ENDED else None, "progress": "", **change}
    of_row = update(table).where(table.c.id == row.id, table.c.state == row.state)
    values = {name: value for name, value in values.items() if name in table.c}
    with centre.database.writing() as connection:
        if connection.execute(of_row.values(**values)).rowcount:
            centre.copies.publish(connection, made)
            result = {
                name: change[name] for name in ("revision", "error") if change.get(name) is not None
            }
            detail = {_LOGGED[kind]: row.id, **result}
            note(connection, now, by, action or state, row.map, **detail)
            if state in _PENDING:
                notify(connection)
    return get(centre, kind, row.id)


def cancel(centre: Centre, row: Job, by: str) -> Job:
    """Ends a job that has not ended; a hand-in that a worker may be merging, by its next heartbeat.

    What a dream has tried is kept.
    """
    if row.state in ENDED:
        return row
    if row.state != JobState.COMPLETE:
        flag: dict[str, Any] = {"cancelled": 1} if isinstance(row, HandIn) else {}
        return set_state(centre, row, JobState.CANCELLED, by, error="cancelled", **flag)
    with centre.database.writing() as connection:
        connection.execute(update(handins).where(handins.c.id == row.id).values(cancelled=1))
        note(connection, centre.now_ns(), by, "cancel", row.map, handin=row.id)
    return get(centre, type(row), row.id)


def heartbeat(centre: Centre, row: HandIn | Dream, progress: str) -> bool:
    """Notes the progress of a job; returns whether it is to end, as it was cancelled."""
    table = TABLES[type(row)]
    of_row = table.c.id == row.id
    with centre.database.writing(durable=False) as connection:
        connection.execute(update(table).where(of_row).values(progress=progress))
    now = get(centre, type(row), row.id)
    return now.state in ENDED or (isinstance(now, HandIn) and bool(now.cancelled))
