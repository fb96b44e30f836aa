"""The robots of a map: what each follows, and what it reports to run."""

from __future__ import annotations

import json
from typing import Any

from sqlalchemy import func, select, update

from engram.centre.errors import UnknownError
from engram.centre.refs import Refs
from engram.centre.service import Centre
from engram.centre.store.audit import note
from engram.centre.store.database import first_row, rows_of
from engram.centre.store.schema import handins, robots, subjects


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
