"""The robots of a map, and the refs that they follow."""

from __future__ import annotations

import json
import re
from typing import Any

from sqlalchemy import delete, func, select, update

from engram.errors import InputError, RevisionError
from engram.fleet.centre.database import first_row, handins, note, refs, robots, rows_of, subjects
from engram.fleet.centre.errors import ChangedError, UnknownError
from engram.fleet.centre.service import Centre
from engram.maps.map import Map

HEAD = "head"
_NAME = re.compile(r"[a-z][a-z0-9._-]{0,39}")


def check_followed(followed: str) -> None:
    """Checks that a robot can follow it: `head`, a number, or a ref's name, made now or later.

    Raises:
        InputError: no ref is ever called so.
    """
    if not followed.isdecimal() and not _NAME.fullmatch(followed):
        raise InputError(
            f"{followed!r:.60} is not a version to follow: head, a number, or a name of a letter, "
            "then letters, digits, . _ -"
        )


def check_movable(ref: str) -> None:
    """Checks that a ref may have this name, and may be moved.

    Raises:
        InputError: it cannot.
    """
    if ref == HEAD or not _NAME.fullmatch(ref):
        raise InputError(
            f"{ref!r:.60} is not the name of a movable version: use a letter, then letters, "
            "digits, . _ -"
        )


class Refs:
    """The refs of a centre's maps."""

    def __init__(self, centre: Centre) -> None:
        self._centre = centre

    def all(self, name: str) -> list[dict[str, Any]]:
        """The refs of a map; `head` first."""
        with self._centre.database.reading() as connection:
            rows = rows_of(connection, select(refs).where(refs.c.map == name).order_by(refs.c.name))
        return [self._head(name), *rows]

    def get(self, name: str, ref: str) -> dict[str, Any]:
        """One ref.

        Raises:
            UnknownError: the map has none of this name.
        """
        if ref == HEAD:
            return self._head(name)
        with self._centre.database.reading() as connection:
            query = select(refs).where(refs.c.map == name, refs.c.name == ref)
            row = first_row(connection, query)
        if row is None:
            raise UnknownError(f"{name} has no ref {ref!r:.60}")
        return row

    def revision(self, name: str, followed: str) -> int:
        """The revision that a ref, or a number, stands for.

        Raises:
            UnknownError: there is none.
        """
        if not followed.isdecimal():
            found: int = self.get(name, followed)["revision"]
            return found
        with self._centre.reading(name) as store:
            try:
                return store.resolve(int(followed[:18]))
            except RevisionError as error:
                raise UnknownError(str(error)) from error

    def version(self, name: str, revision: int) -> str:
        """A name of a revision that no other one ever has, even after a backup was restored."""
        with self._centre.reading(name) as store:
            found = store.newest_revision(store.resolve(revision))
        return f"{revision}-{found.committed_ns:x}" if found is not None else "0"

    def move(self, name: str, ref: str, revision: int, by: str, expected: int | None) -> int:
        """Moves a ref, or makes it.

        Args:
            name: of the map.
            ref: of the ref.
            revision: where to.
            by: who.
            expected: its version so far, 0 for a new one; None for whatever.

        Returns:
            Its version now.

        Raises:
            ChangedError: it has another version.
            InputError: the name cannot be one, or there is no such revision.
        """
        check_movable(ref)
        with self._centre.reading(name) as store:
            if not 1 <= revision <= store.revision:
                raise InputError(f"{name} has revisions 1 to {store.revision}, not {revision}")
        now = self._centre.now_ns()
        with self._centre.database.writing() as connection:
            query = select(refs).where(refs.c.map == name, refs.c.name == ref)
            row = first_row(connection, query)
            version = 0 if row is None else row["version"]
            if expected is not None and expected != version:
                raise ChangedError(f"{ref} is at version {version}, not {expected}: read it again")
            if row is not None and row["revision"] == revision:
                return version
            moved = {
                "map": name,
                "name": ref,
                "revision": revision,
                "version": version + 1,
                "moved_ns": now,
                "moved_by": by,
            }
            self._centre.database.put(connection, refs, moved)
            note(connection, now, by, "ref", name, ref=ref, revision=revision)
        return version + 1

    def remove(self, name: str, ref: str, by: str) -> None:
        """Removes a ref; robots that follow it stay where they are."""
        self.get(name, ref)
        with self._centre.database.writing() as connection:
            connection.execute(delete(refs).where(refs.c.map == name, refs.c.name == ref))
            note(connection, self._centre.now_ns(), by, "ref-removed", name, ref=ref)

    def _head(self, name: str) -> dict[str, Any]:
        with self._centre.reading(name) as store:
            newest = store.derived(Map.newest_revision)
        return {
            "map": name,
            "name": HEAD,
            "revision": newest.number if newest else 0,
            "version": newest.number if newest else 0,
            "moved_ns": newest.committed_ns if newest else 0,
            "moved_by": newest.author if newest else "",
        }


class Fleet:
    """Robots and their reports."""

    def __init__(self, centre: Centre) -> None:
        self._centre = centre

    def all(self, name: str) -> list[dict[str, Any]]:
        """The robots of a map, by name."""
        handed = (
            select(handins.c.robot, func.count().label("handins"))
            .where(handins.c.map == name)
            .group_by(handins.c.robot)
            .subquery()
        )
        query = (
            select(robots, subjects.c.name, subjects.c.disabled, handed.c.handins)
            .join(subjects, subjects.c.id == robots.c.robot)
            .outerjoin(handed, handed.c.robot == robots.c.robot)
            .where(robots.c.map == name)
            .order_by(subjects.c.name, robots.c.robot)
        )
        with self._centre.database.reading() as connection:
            rows = rows_of(connection, query)
        return [{**row, "report": json.loads(row["report"])} for row in rows]

    def wanted(self, name: str, robot: str) -> dict[str, Any]:
        """The version that a robot is to run: its ref, the revision, and what it may drop.

        Where its ref is not made yet, or was removed, that is revision 0: it stays where it is, and
        hands in, since the first hand-in may be what makes the ref.

        Raises:
            UnknownError: it is not a robot of this map.
        """
        with self._centre.database.reading() as connection:
            query = select(robots).where(robots.c.map == name, robots.c.robot == robot)
            row = first_row(connection, query)
        if row is None:
            raise UnknownError(f"{name} has no robot {robot!r:.40}; enrol it first")
        try:
            revision = Refs(self._centre).revision(name, row["follows"])
        except UnknownError:
            revision = 0
        return {
            "follows": row["follows"],
            "revision": revision,
            "version": Refs(self._centre).version(name, revision),
            "durable_revision": self._centre.map_row(name)["durable_revision"],
        }

    def report(self, name: str, robot: str, told: dict[str, Any]) -> dict[str, Any]:
        """Keeps what a robot runs and has localised with; returns what it is to run."""
        now = self._centre.now_ns()
        with self._centre.database.writing(durable=False) as connection:
            connection.execute(
                update(robots)
                .where(robots.c.map == name, robots.c.robot == robot)
                .values(report=json.dumps(told), reported_ns=now)
            )
        return self.wanted(name, robot)

    def follow(self, name: str, robot: str, ref: str, by: str) -> None:
        """Lets a robot follow a ref, or pins it to a revision.

        Raises:
            UnknownError: there is no such robot, ref or revision.
        """
        Refs(self._centre).revision(name, ref)
        with self._centre.database.writing() as connection:
            changed = connection.execute(
                update(robots)
                .where(robots.c.map == name, robots.c.robot == robot)
                .values(follows=ref)
            )
            if not changed.rowcount:
                raise UnknownError(f"{name} has no robot {robot!r:.40}")
            note(connection, self._centre.now_ns(), by, "follow", name, robot=robot, ref=ref)
