"""The robots of a map, and the refs that they follow."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from sqlalchemy import delete, func, select, update

from engram.errors import InputError, RevisionError
from engram.fleet.centre.database import first_row, note
from engram.fleet.centre.problems import ChangedError, UnknownError
from engram.fleet.centre.service import Centre
from engram.fleet.centre.tables import Ref, RobotOnMap, handins, refs, robots, subjects
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


def refs_of(centre: Centre, name: str) -> list[Ref]:
    """The refs of a map; `head` first."""
    rows = centre.database.rows(Ref, refs.c.map == name, order=refs.c.name)
    return [_head(centre, name), *rows]


def ref_of(centre: Centre, name: str, ref: str) -> Ref:
    """One ref of a map.

    Raises:
        UnknownError: the map has none of this name.
    """
    if ref == HEAD:
        return _head(centre, name)
    row = centre.database.row(Ref, refs.c.map == name, refs.c.name == ref)
    if row is None:
        raise UnknownError(f"{name} has no ref {ref!r:.60}")
    return row


def _head(centre: Centre, name: str) -> Ref:
    with centre.reading(name) as store:
        newest = store.derived(Map.newest_revision)
    if newest is None:
        return Ref(name, HEAD, revision=0, version=0, moved_ns=0, moved_by="")
    return Ref(name, HEAD, newest.number, newest.number, newest.committed_ns, newest.author)


def revision_of(centre: Centre, name: str, followed: str) -> int:
    """The revision that a ref, or a number, stands for.

    Raises:
        UnknownError: there is none.
    """
    if not followed.isdecimal():
        return ref_of(centre, name, followed).revision
    with centre.reading(name) as store:
        try:
            return store.resolve(int(followed[:18]))
        except RevisionError as error:
            raise UnknownError(str(error)) from error


def version_of(centre: Centre, name: str, revision: int) -> str:
    """A name of a revision that no other one ever has, even after a backup was restored."""
    with centre.reading(name) as store:
        found = store.newest_revision(store.resolve(revision))
    return f"{revision}-{found.committed_ns:x}" if found is not None else "0"


def move_ref(
    centre: Centre, name: str, ref: str, revision: int, by: str, expected: int | None = None
) -> int:
    """Moves a ref, or makes it.

    Args:
        centre: the centre.
        name: of the map.
        ref: of the ref.
        revision: the new target.
        by: who.
        expected: its version so far, 0 for a new one; None for any.

    Returns:
        Its version now.

    Raises:
        ChangedError: it has another version.
        InputError: the name cannot be one, or there is no such revision.
    """
    check_movable(ref)
    with centre.reading(name) as store:
        if not 1 <= revision <= store.revision:
            raise InputError(f"{name} has revisions 1 to {store.revision}, not {revision}")
    now = centre.now_ns()
    with centre.database.writing() as connection:
        row = first_row(connection, Ref, refs.c.map == name, refs.c.name == ref)
        version = 0 if row is None else row.version
        if expected is not None and expected != version:
            raise ChangedError(f"{ref} is at version {version}, not {expected}: read it again")
        if row is not None and row.revision == revision:
            return version
        centre.database.put(connection, Ref(name, ref, revision, version + 1, now, by))
        note(connection, now, by, "ref", name, ref=ref, revision=revision)
    return version + 1


def remove_ref(centre: Centre, name: str, ref: str, by: str) -> None:
    """Removes a ref; robots that follow it stay where they are."""
    ref_of(centre, name, ref)
    with centre.database.writing() as connection:
        connection.execute(delete(refs).where(refs.c.map == name, refs.c.name == ref))
        note(connection, centre.now_ns(), by, "ref-removed", name, ref=ref)


@dataclass(frozen=True, slots=True)
class RobotListed:
    """A robot, what it follows, and its last report."""

    robot: str
    map: str
    follows: str
    report: dict[str, Any]
    reported_ns: int | None
    name: str
    disabled: int
    handins: int | None


@dataclass(frozen=True, slots=True)
class Wanted:
    """Which version a robot is to run, and which of its hand-ins it may drop."""

    follows: str
    revision: int
    version: str
    durable_revision: int


def robots_of(centre: Centre, name: str) -> list[RobotListed]:
    """The robots of a map, by name."""
    counts = (
        select(handins.c.robot, func.count().label("handins"))
        .where(handins.c.map == name)
        .group_by(handins.c.robot)
        .subquery()
    )
    query = (
        select(robots, subjects.c.name, subjects.c.disabled, counts.c.handins)
        .join(subjects, subjects.c.id == robots.c.robot)
        .outerjoin(counts, counts.c.robot == robots.c.robot)
        .where(robots.c.map == name)
        .order_by(subjects.c.name, robots.c.robot)
    )
    with centre.database.reading() as connection:
        return [RobotListed(*row) for row in connection.execute(query)]


def wanted_by(centre: Centre, name: str, robot: str) -> Wanted:
    """The version that a robot is to run: its ref, the revision, and what it may drop.

    Where its ref is not made yet, or was removed, that is revision 0: it keeps its version, and
    hands in, since the first hand-in may be what makes the ref.

    Raises:
        UnknownError: it is not a robot of this map.
    """
    row = centre.database.row(RobotOnMap, robots.c.map == name, robots.c.robot == robot)
    if row is None:
        raise UnknownError(f"{name} has no robot {robot!r:.40}; enrol it first")
    try:
        revision = revision_of(centre, name, row.follows)
    except UnknownError:
        revision = 0
    version, durable = version_of(centre, name, revision), centre.map_row(name).durable_revision
    return Wanted(row.follows, revision, version, durable)


def note_report(centre: Centre, name: str, robot: str, report: dict[str, Any]) -> Wanted:
    """Keeps what a robot runs and has localised with; returns what it is to run.

    With it stays as `ran_before` the version that the robot ran before this one.
    """
    one = (robots.c.map == name, robots.c.robot == robot)
    with centre.database.writing(durable=False) as connection:
        row = first_row(connection, RobotOnMap, *one)
        last = {} if row is None else row.report
        same = last.get("runs") == report.get("runs")
        before = last.get("ran_before") if same else last.get("runs")
        change = {"report": {**report, "ran_before": before}, "reported_ns": centre.now_ns()}
        connection.execute(update(robots).where(*one).values(**change))
    return wanted_by(centre, name, robot)


def follow(centre: Centre, name: str, robot: str, ref: str, by: str) -> None:
    """Lets a robot follow a ref, or pins it to a revision.

    Raises:
        UnknownError: there is no such robot, ref or revision.
    """
    revision_of(centre, name, ref)
    of_robot = update(robots).where(robots.c.map == name, robots.c.robot == robot)
    with centre.database.writing() as connection:
        if not connection.execute(of_robot.values(follows=ref)).rowcount:
            raise UnknownError(f"{name} has no robot {robot!r:.40}")
        note(connection, centre.now_ns(), by, "follow", name, robot=robot, ref=ref)
