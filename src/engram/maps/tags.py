"""Tags of revisions, and where a map comes from."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass

from sqlalchemy import Connection, func, insert, select

from engram.errors import InputError, RevisionError
from engram.graph.model import NodeId, SessionId
from engram.maps.rows import (
    Row,
    checked_text,
    count_tags,
    node_from_bytes,
    sealed,
    uuid_from_bytes,
    verified,
)
from engram.maps.schema import hidden, nodes, revisions, sessions, tags
from engram.maps.view import KeyBook, View, head, place_in_history

HEAD = "head"
# A letter first, so that no tag looks like a number or an option; no `~`, which means steps back.
_TAG = re.compile(r"[A-Za-z][A-Za-z0-9._/+-]{0,99}")
_STEPS = re.compile(r"(?P<base>.*?)(?:~(?P<steps>\d{1,9})?)?", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Tag:
    """A name of a revision.

    Attributes:
        name: as given.
        number: of the revision.
        author: the person or robot that set it.
        message: reason; "" without one.
        tagged_ns: when, UTC, ns.
    """

    name: str
    number: int
    author: str
    message: str
    tagged_ns: int


def load_tags(connection: Connection) -> dict[str, Tag]:
    """All current tags by name, sorted by name."""
    newest: dict[str, Tag | None] = {}
    for row in verified(tags, connection.execute(select(tags).order_by(tags.c.key))):
        newest[row["name"]] = (
            None
            if row["number"] is None
            else Tag(row["name"], row["number"], row["author"], row["message"], row["tagged_ns"])
        )
    return {name: tag for name, tag in sorted(newest.items()) if tag is not None}


def resolve(connection: Connection, named: int | str | None, where: str) -> int:
    """Number of a revision from its name.

    Args:
        connection: of the map.
        named: a number, a tag, "head" or None for the newest; a text may end in ``~N`` for N
            revisions before, ``~`` for one.
        where: the map's name, for messages.

    Raises:
        RevisionError: the map has no such revision.
    """
    newest = head(connection)
    if named is None:
        return newest
    number = named if isinstance(named, int) else _number(connection, named, newest, where)
    if not 0 <= number <= newest:
        told = f" ({named})" if str(named) != str(number) else ""
        raise RevisionError(f"{where} has revisions 1 to {newest}, not {number}{told}")
    return number


def _number(connection: Connection, named: str, newest: int, where: str) -> int:
    found = _STEPS.fullmatch(named)
    assert found is not None  # the expression matches every text
    base = found["base"]
    back = int(found["steps"] or 1) if "~" in named else 0
    if re.fullmatch(r"-?\d{1,18}", base, re.ASCII):
        return int(base) - back
    if base.lower() == HEAD:
        return newest - back
    known = load_tags(connection)
    if base not in known:
        told = f"; its tags: {', '.join(known)}" if known else "; it has no tags"
        raise RevisionError(
            f"{where} has no revision named {named!r}: give a number from 1 to {newest}, "
            f"{HEAD}, or a tag{told}"
        )
    return known[base].number - back


@dataclass(frozen=True, slots=True)
class TagWriter:
    """Sets and removes tags of a map.

    Attributes:
        connection: of the map, open for writing.
        keys: the map's.
        where: the map's name, for messages.
    """

    connection: Connection
    keys: KeyBook
    where: str

    def set(
        self, name: str, named: int | str | None, author: str, message: str, *, move: bool
    ) -> Tag:
        """See `Map.tag`."""
        _check_tag(name)
        number = resolve(self.connection, named, self.where)
        if number == 0:
            newest = head(self.connection)
            raise RevisionError(
                f"{self.where} has revisions 1 to {newest}; 0 is before the first and cannot be "
                "tagged"
                if newest
                else f"{self.where} has no revision yet to tag"
            )
        known = load_tags(self.connection).get(name)
        if known is not None and known.number != number and not move:
            raise RevisionError(
                f"revision {known.number} of {self.where} is tagged {name!r} already; choose "
                "another name, or move the tag"
            )
        if known is None or known.number != number:
            self._write(name, number, author, message)
        return load_tags(self.connection)[name]

    def remove(self, name: str, author: str) -> Tag:
        """See `Map.untag`."""
        known = load_tags(self.connection)
        if name not in known:
            raise RevisionError(
                f"{self.where} has no tag {name!r}; its tags: {', '.join(known) or 'none'}"
            )
        self._write(name, None, author, "")
        return known[name]

    def _write(self, name: str, number: int | None, author: str, message: str) -> None:
        """Writes a tag; None as the number removes it."""
        row = {
            "key": self.keys.next(tags),
            "name": name,
            "number": number,
            "author": checked_text(author, "author"),
            "message": checked_text(message, "message"),
            "tagged_ns": time.time_ns(),
        }
        self.connection.execute(insert(tags), [sealed(tags, row)])
        count_tags(self.connection)


def _check_tag(name: str) -> None:
    if not _TAG.fullmatch(name) or name.lower() == HEAD:
        raise InputError(
            f"{name!r} cannot be a tag: a letter, then letters, digits and . _ / + -, 100 at "
            f"most, and not {HEAD!r}"
        )


_HEX = frozenset("0123456789abcdef")
_LISTED = 5


@dataclass(frozen=True, slots=True)
class Origin:
    """A node and its history.

    Attributes:
        node: its id.
        session: of the drive that saved it.
        robot: of that drive.
        stamp_ns: of its frame.
        driven_m: odometry distance from the session's start.
        brought: number of the revision that added it.
        told: (number, hidden) for each later revision that hid it or showed it again.
    """

    node: NodeId
    session: SessionId
    robot: str
    stamp_ns: int
    driven_m: float
    brought: int
    told: tuple[tuple[int, bool], ...]

    @property
    def visible(self) -> bool:
        """Whether the node is visible at the chosen revision."""
        return not (self.told and self.told[-1][1])


def origin_of(connection: Connection, view: View, prefix: str) -> Origin:
    """The one node whose UUID begins with `prefix`, hidden ones included.

    Args:
        connection: of the map.
        view: the view of a revision.
        prefix: hexadecimal digits, with or without hyphens.

    Raises:
        InputError: no node or several match, or the prefix is not valid.
    """
    digits = prefix.strip().lower().replace("-", "")
    if not digits or not _HEX.issuperset(digits) or len(digits) > 32:
        raise InputError(f"{prefix!r} is not a UUID or the beginning of one")
    brought = nodes.c.revision.in_(view.revision_keys())
    begins = _between(digits)
    query = select(nodes).where(brought, nodes.c.uuid >= begins[0], nodes.c.uuid <= begins[1])
    rows = list(verified(nodes, connection.execute(query.order_by(nodes.c.uuid))))
    if not rows:
        count = connection.execute(select(func.count()).select_from(nodes).where(brought)).scalar()
        raise InputError(f"none of the map's {count} nodes begins with {prefix!r}")
    if len(rows) > 1:
        listed = ", ".join(str(node_from_bytes(row["uuid"])) for row in rows[:_LISTED])
        more = f" and {len(rows) - _LISTED} more" if len(rows) > _LISTED else ""
        raise InputError(f"{len(rows)} nodes begin with {prefix!r}, give more: {listed}{more}")
    return _origin(connection, view, rows[0])


def _between(digits: str) -> tuple[bytes, bytes]:
    """The smallest and the largest UUID that begin with `prefix`."""
    return bytes.fromhex(digits.ljust(32, "0")), bytes.fromhex(digits.ljust(32, "f"))


def _origin(connection: Connection, view: View, row: Row) -> Origin:
    number = select(revisions.c.number).where(revisions.c.key == row["revision"])
    owner = select(sessions).where(sessions.c.key == row["session"])
    session = next(verified(sessions, connection.execute(owner)))
    told = (
        select(revisions.c.number, hidden.c.hidden)
        .select_from(hidden.join(revisions, revisions.c.key == hidden.c.revision))
        .where(hidden.c.record == nodes.name, hidden.c.target == row["key"])
        .where(hidden.c.revision.in_(view.revision_keys()))
        .order_by(place_in_history(), hidden.c.key)
    )
    return Origin(
        node=node_from_bytes(row["uuid"]),
        session=SessionId(uuid_from_bytes(session["uuid"], "a session")),
        robot=session["robot"],
        stamp_ns=row["stamp_ns"],
        driven_m=row["driven_m"],
        brought=connection.execute(number).scalar_one(),
        told=tuple((by, bool(hid)) for by, hid in connection.execute(told)),
    )
