"""Hides rows and shows them again: a revert does not rewrite history.

A revert writes one `hidden` row for each row that its revision added. Records that are added again
later are shown by a newer `hidden` row; of the rows for one target the newest counts.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Table, insert, select

from engram.counts import counted
from engram.errors import InputError, RevisionError
from engram.graph.model import Node, Session
from engram.maps.columns import Visible
from engram.maps.difference import MapDifference, difference
from engram.maps.records import Revision
from engram.maps.rows import Row, sealed, session_row, verified
from engram.maps.schema import (
    VERSIONED,
    attempts,
    edges,
    frames,
    hidden,
    metadata,
    nodes,
    omissions,
    path_entries,
    paths,
    receipts,
    revisions,
    sessions,
)
from engram.maps.totals import own_rows
from engram.maps.view import KeyBook, View, few


@dataclass(frozen=True, slots=True, eq=False)
class Reverted:
    """The result of a revert, or of a dry run.

    Attributes:
        number: the reverted revision.
        revision: the new revision; None if nothing was written.
        difference: the map before and after.
        lost_by_others: number of rows of other revisions, by table, that are hidden with it: they
            refer to hidden nodes, or the revision had shown them again.
        regained_by_others: number of their rows, by table, that are shown again.
    """

    number: int
    revision: Revision | None
    difference: MapDifference
    lost_by_others: Mapping[str, int]
    regained_by_others: Mapping[str, int]

    def to_dict(self) -> dict[str, Any]:
        """What ``revert --json`` prints."""
        return {
            "reverted": self.number,
            "revision": None if self.revision is None else self.revision.number,
            "lost_by_others": dict(self.lost_by_others),
            "regained_by_others": dict(self.regained_by_others),
            "difference": self.difference.to_dict(),
        }

    def text(self) -> str:
        """The result as text."""
        old, new = self.difference.old, self.difference.new
        by = "would be reverted" if self.revision is None else f"reverted by {self.revision.number}"
        lines = [
            f"revision {self.number} {by}",
            f"nodes      {old.nodes} → {new.nodes}",
            f"components {old.components} → {new.components}",
        ]
        if lost := _rows_text(self.lost_by_others):
            lines.append(f"other revisions depend on it: {lost} of theirs are hidden with it")
        if regained := _rows_text(self.regained_by_others):
            lines.append(f"of other revisions, {regained} are shown again")
        if new.components > old.components:
            lines.append("the map has more components: positions cannot be carried between them")
        return "\n".join(lines)


def hidden_row(keys: KeyBook, revision_key: int, table: Table, target: int, *, hide: bool) -> Row:
    """A row of `hidden`, which hides a row of another table or shows it again."""
    row = {
        "key": keys.next(hidden),
        "revision": revision_key,
        "record": str(table.name),
        "target": target,
        "hidden": int(hide),
    }
    return sealed(hidden, row)


def hidden_rows(connection: Connection, seen: Visible, table: Table) -> dict[bytes, Row]:
    """The rows that a revert has hidden, by UUID."""
    found = {}
    for part in few(sorted(seen.hidden_of(table))):
        query = select(table).where(table.c.key.in_(part)).order_by(table.c.key)
        for row in verified(table, connection.execute(query)):
            if row["revision"] in seen.places:
                found[row["uuid"]] = row
    return found


def check_same_node(row: Row, node: Node, landmark_hash: bytes) -> None:
    """Refuses to show a hidden node again with other content.

    Raises:
        InputError: it has other landmarks or another stamp.
    """
    if (row["landmark_hash"], row["stamp_ns"]) != (landmark_hash, node.stamp_ns):
        raise InputError(
            f"node {node.id} was in the map before with other landmarks; a node never changes: "
            "use the same front-end settings as then, or map the drive into another map"
        )


def check_same_session(row: Row, session: Session, camera: int, frontend: int) -> None:
    """Refuses to show a hidden session again with other content.

    Raises:
        InputError: its robot, camera, front-end, clock or place on Earth differ.
    """
    now = session_row(session, row["key"], row["revision"], camera, frontend)
    for name in ("robot", "camera", "frontend", "start_ns", "clock", "longitude_deg", "zone"):
        if now[name] != row[name]:
            raise InputError(
                f"session {session.id} was in the map before with {name} {row[name]}, now "
                f"{now[name]}; a session never changes: use the same values as then, or map the "
                "drive into another map"
            )


def hide_revision(
    connection: Connection, keys: KeyBook, view: View, number: int, revision_key: int
) -> None:
    """Writes the rows that revert a revision.

    Rows that it added are hidden; rows that it hid or showed are shown or hidden again. Sessions
    and paths to which visible rows belong stay visible, or are shown again.

    Args:
        connection: inside a transaction.
        keys: the writer's.
        view: the newest revision, and the open one.
        number: number of the revision to revert.
        revision_key: key of the open revision that reverts it.

    Raises:
        RevisionError: nothing of it is visible.
    """
    query = select(revisions).where(revisions.c.number == number)
    own = own_rows(next(verified(revisions, connection.execute(query))))
    written = _invert_hidden(connection, keys, view, own.key, revision_key)
    # Owners last: they stay visible while any visible row belongs to them.
    owned = [table for table in VERSIONED if table not in {hidden, frames, paths, sessions}]
    for table in (*owned, paths, sessions):
        brought = (
            select(table.c.key)
            .where(own.rows(table), table.c.key.not_in(view.hidden_keys(table)))
            .order_by(table.c.key)
        )
        found = list(connection.execute(brought).scalars())
        used = _used(connection, view, table, found)
        rows = [
            hidden_row(keys, revision_key, table, one, hide=True)
            for one in found
            if one not in used
        ]
        if rows:
            connection.execute(insert(hidden), rows)
        written += len(rows)
    written += _show_owners(connection, keys, view, revision_key)
    if not written:
        raise RevisionError(f"revision {number} has nothing to revert: none of its rows is visible")


def _used(connection: Connection, view: View, table: Table, found: list[int]) -> set[int]:
    """Those of these sessions or paths that own visible rows."""
    owned = {sessions: (nodes, paths, attempts), paths: (path_entries,)}.get(table, ())
    column = {sessions: "session", paths: "path"}.get(table, "")
    return {
        key
        for owner in owned
        for part in few(found)
        for key in connection.execute(
            view.select(owner)
            .with_only_columns(owner.c[column])
            .where(owner.c[column].in_(part))
            .distinct()
            .order_by(None)
        ).scalars()
    }


def _show_owners(connection: Connection, keys: KeyBook, view: View, revision_key: int) -> int:
    """Shows the hidden paths and sessions to which rows belong that are shown again by now."""
    written = 0
    for table in (paths, sessions):
        query = select(table.c.key).where(table.c.key.in_(view.hidden_keys(table)))
        concealed = list(connection.execute(query.order_by(table.c.key)).scalars())
        rows = [
            hidden_row(keys, revision_key, table, one, hide=False)
            for one in sorted(_used(connection, view, table, concealed))
        ]
        if rows:
            connection.execute(insert(hidden), rows)
        written += len(rows)
    return written


def _invert_hidden(
    connection: Connection, keys: KeyBook, view: View, target: int, revision_key: int
) -> int:
    """Undoes the hidings and showings of a revision that are still the newest."""
    query = select(hidden).where(hidden.c.revision == target).order_by(hidden.c.key)
    made = list(verified(hidden, connection.execute(query)))
    if not made:
        return 0
    newest = {(row["record"], row["target"]): row for row in view.rows(connection, hidden)}
    made = [row for row in made if newest[row["record"], row["target"]]["key"] == row["key"]]
    _check_not_erased(connection, made)
    rows = [
        hidden_row(
            keys,
            revision_key,
            metadata.tables[row["record"]],
            row["target"],
            hide=not row["hidden"],
        )
        for row in made
    ]
    if rows:
        connection.execute(insert(hidden), rows)
    return len(rows)


def _check_not_erased(connection: Connection, made: list[Row]) -> None:
    """Refuses to show again what is no longer there.

    Raises:
        RevisionError: a row was erased.
    """
    targets = defaultdict(list)
    for row in made:
        targets[row["record"]].append(row["target"])
    for record, keys in targets.items():
        for part in few(keys):
            erased = (receipts.c.record == record) & receipts.c.target.in_(part)
            if connection.execute(select(receipts.c.key).where(erased).limit(1)).first():
                raise RevisionError("what it forgot has since been erased and cannot be restored")


def compare(connection: Connection, number: int, before: int, after: Revision) -> Reverted:
    """The map before and after a revert."""
    found = difference(connection, before, after.number)
    query = select(revisions.c.key).where(revisions.c.number == number)
    key = connection.execute(query).scalar_one()
    lost, regained = (
        {
            str(table.name): int((touched.seen[side] & ~touched.seen[1 - side] & others).sum())
            for table in (edges, path_entries, omissions)
            for touched in [found.changes[table]]
            for others in [touched.rows["revision"] != key]
        }
        for side in (0, 1)
    )
    return Reverted(number, after, found, lost, regained)


def _rows_text(counts: Mapping[str, int]) -> str:
    """Number of rows by table, without tables that have none."""
    return ", ".join(counted(count, _one_of(name)) for name, count in counts.items() if count)


def _one_of(table: str) -> str:
    """A row of a table, as it is called: `path_entries` has path entries."""
    name = table.replace("_", " ")
    return f"{name[:-3]}y" if name.endswith("ies") else name.removesuffix("s")
