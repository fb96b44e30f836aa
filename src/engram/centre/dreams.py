"""Dreams: jobs that look for a better map in what robots handed in.

A dream is what is handed in, how it is merged and what judges it: each is dreamt of once.
"""

from __future__ import annotations

import hashlib
import json
from contextlib import closing, suppress
from typing import Any

from sqlalchemy import select, update

from engram.centre.errors import ConflictError, UnknownError
from engram.centre.keeping import ASKED, CANCELLED, DONE, newest_merged
from engram.centre.parts import Parts
from engram.centre.resident import log_of
from engram.centre.service import Centre
from engram.centre.store.audit import note
from engram.centre.store.database import first_row, rows_of
from engram.centre.store.packs import given_by
from engram.centre.store.schema import dreams, handins
from engram.centre.store.waking import ring
from engram.config import to_dict
from engram.counts import counted
from engram.fleet.dream import FEWEST_DRIVES
from engram.maps.exchange import MapRows
from engram.maps.schema import frames, nodes
from engram.transfers import Manifest, PartHash, part_hash
from engram.transfers.join import blobs_named
from engram.transfers.pages import decode_page

WORKER = "worker"
_LISTED = 100


class Dreams:
    """The dreams of a centre."""

    def __init__(self, centre: Centre) -> None:
        self._centre = centre

    def ask(self, name: str, by: str) -> dict[str, Any]:
        """Asks for a dream of what is handed in now; one that failed or was cancelled, again.

        Raises:
            ConflictError: there is nothing to dream of, or too little to judge it by.
        """
        gate = self._centre.policy(name).gate
        if len(gate) < FEWEST_DRIVES:
            raise ConflictError(
                f"{name} has {counted(len(gate), 'held-out drive')}, too few to rule out chance; "
                f"give at least {FEWEST_DRIVES} with engram centre map --gate"
            )
        if not self.handed(name):
            raise ConflictError(f"nothing is merged into {name} yet: there is nothing to dream of")
        with self._centre.reading(name) as store:
            since = store.revision
        now, key = self._centre.now_ns(), self.key(name)
        row = {
            "id": key,
            "map": name,
            "state": ASKED,
            "asked_by": by,
            "asked_ns": now,
            "ended_ns": None,
            "since": since,
            "revision": None,
            "progress": "",
            "report": None,
            "error": None,
        }
        with self._centre.database.writing() as connection:
            known = first_row(connection, select(dreams).where(dreams.c.id == key))
            again = by != WORKER and known is not None and known["state"] != DONE
            if known is None or again:
                self._centre.database.put(connection, dreams, row)
                note(connection, now, by, "dream", name, dream=key)
                ring(connection)
        return self.get(key)

    def ask_quietly(self) -> None:
        """Asks for the dreams of maps whose quiet hours these are."""
        for name in self._centre.map_names():
            if self._centre.policy(name).is_quiet(self._centre.now_ns()):
                with suppress(ConflictError):
                    self.ask(name, WORKER)

    def get(self, key: str) -> dict[str, Any]:
        """The row of a dream.

        Raises:
            UnknownError: there is none.
        """
        with self._centre.database.reading() as connection:
            row = first_row(connection, select(dreams).where(dreams.c.id == key))
        if row is None:
            raise UnknownError(f"there is no dream {key!r:.40}")
        return row

    def listed(self, name: str, state: str | None = None) -> list[dict[str, Any]]:
        """Dreams of a map, newest first."""
        query = select(dreams).where(dreams.c.map == name)
        if state is not None:
            query = query.where(dreams.c.state == state)
        query = query.order_by(dreams.c.asked_ns.desc()).limit(_LISTED)
        with self._centre.database.reading() as connection:
            return rows_of(connection, query)

    def due(self) -> list[dict[str, Any]]:
        """Dreams to run now; outdated ones are cancelled and requested again."""
        found = []
        for name in self._centre.map_names():
            for row in self.listed(name, ASKED):
                if self.key(name) != row["id"]:
                    self.end(row, CANCELLED, error="robots have handed in since")
                    with suppress(ConflictError):
                        self.ask(name, row["asked_by"])
            found += [row for row in self.listed(name, ASKED) if self.is_due(row)]
        return found

    def is_due(self, row: dict[str, Any]) -> bool:
        """Whether it is requested, and by a person or within quiet hours."""
        now = self.get(row["id"])
        quiet = self._centre.policy(row["map"]).is_quiet(self._centre.now_ns())
        return now["state"] == ASKED and (quiet or now["asked_by"] != WORKER)

    def cancel(self, row: dict[str, Any], by: str) -> dict[str, Any]:
        """Ends a dream; what was tried is kept."""
        if row["state"] != ASKED:
            return row
        self.end(row, CANCELLED, by, error="cancelled")
        return self.get(row["id"])

    def heartbeat(self, key: str, progress: str) -> bool:
        """Notes how far a dream is; whether it has been ended meanwhile."""
        with self._centre.database.writing(durable=False) as connection:
            connection.execute(update(dreams).where(dreams.c.id == key).values(progress=progress))
            state = connection.execute(select(dreams.c.state).where(dreams.c.id == key)).scalar()
        return state != ASKED

    def end(self, row: dict[str, Any], state: str, by: str = WORKER, **change: Any) -> None:
        """Ends a dream that has not ended; one transaction, with its event."""
        now = self._centre.now_ns()
        asked = (dreams.c.id == row["id"]) & (dreams.c.state == ASKED)
        if "report" in change:
            change["report"] = json.dumps(change["report"])
        values = {"state": state, "ended_ns": now, "progress": "", **change}
        with self._centre.database.writing() as connection:
            if connection.execute(update(dreams).where(asked).values(**values)).rowcount:
                told = {
                    one: change[one] for one in ("revision", "error") if change.get(one) is not None
                }
                note(connection, now, by, state, row["map"], dream=row["id"], **told)

    def key(self, name: str) -> str:
        """The name of the dream of what is handed in now."""
        policy = self._centre.policy(name)
        given = [row["manifest"] for row in self.handed(name)]
        about = json.dumps([name, given, policy.gate, to_dict(policy.merge)], sort_keys=True)
        return hashlib.sha256(about.encode()).hexdigest()[:32]

    def handed(self, name: str) -> list[dict[str, Any]]:
        """Each robot's newest merged hand-in, oldest first: it holds all that the robot mapped.

        Robots of which something was reverted since are left out until they hand in again: a dream
        brings nothing back that a person hid.
        """
        query = select(handins).where(handins.c.map == name).order_by(handins.c.place)
        with self._centre.database.reading() as connection:
            newest = rows_of(connection, query.where(handins.c.place.in_(newest_merged(name))))
            merged = connection.execute(
                select(handins.c.robot, handins.c.revision).where(
                    handins.c.map == name, handins.c.revision.is_not(None)
                )
            ).all()
        with self._centre.reading(name) as store:
            log = log_of(store)
        hidden = {one.configuration["revert"]: one.number for one in log if _reverts(one)}
        reverted: dict[str, int] = {}
        for robot, revision in merged:
            reverted[robot] = max(reverted.get(robot, 0), hidden.get(revision, 0))
        return [row for row in newest if (row["revision"] or 0) >= reverted.get(row["robot"], 0)]

    def parts(self, row: dict[str, Any], manifest: Manifest) -> dict[PartHash, bytes]:
        """Pages and blobs of a merged hand-in: its robot's own, or the fleet map's."""
        packs = self._centre.packs(row["map"])
        found = dict(packs.read(dict.fromkeys(manifest.hashes())))
        named = [one for _, _, some in blobs_named(manifest, found.get) for one in some]
        with self._centre.database.reading() as connection:
            own = given_by(connection, row["map"], row["robot"], named)
        found |= dict(packs.read(dict.fromkeys(one for one in named if one in own)))
        if any(one not in found for one in named):
            found |= self._of_fleet_map(row["map"], manifest, found)
        return found

    def _of_fleet_map(
        self, name: str, manifest: Manifest, pages: dict[PartHash, bytes]
    ) -> dict[PartHash, bytes]:
        """Blobs that the robot got from the fleet map, and so does not hand in."""
        kept = [pages[one] for one in manifest.pages.get("nodes", ())]
        uuids = {row[1] for page in kept for row in decode_page(nodes, page)}
        found = {}
        with closing(MapRows(self._centre.map_path(name))) as rows:
            for key in [row[0] for row in rows.of(nodes) if row[1] in uuids]:
                for body in rows.one(frames, key)[2:4]:
                    if body is not None:
                        found[part_hash(body)] = body
        return found

    def manifest(self, row: dict[str, Any]) -> Manifest:
        """The manifest of a merged hand-in."""
        return Parts(self._centre).manifest(row)


def _reverts(revision: Any) -> bool:
    return isinstance(revision.configuration.get("revert"), int)
