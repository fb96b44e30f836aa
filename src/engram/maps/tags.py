"""Tags of revisions."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass

from sqlalchemy import Connection, insert, select

from engram.errors import InputError, RevisionError
from engram.maps.rows import checked_text, count_tags, sealed, verified
from engram.maps.schema import tags
from engram.maps.view import KeyBook, head

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
