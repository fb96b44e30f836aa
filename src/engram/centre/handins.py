"""Hand-ins: from a manifest to a job.

A hand-in is its manifest, of one robot, on one map: begun twice it is the same. A part is its hash.
A complete hand-in's row is the job; there is no other queue.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

from sqlalchemy import Connection, func, or_, select, update

from engram.centre.errors import (
    ConflictError,
    MalformedError,
    QuotaError,
    UnknownError,
)
from engram.centre.keeping import ENDED, HandInState, manifest_key, needed_manifests
from engram.centre.parts import Parts
from engram.centre.service import Centre, kept_since_ns
from engram.centre.settings import DAY_NS
from engram.centre.store.audit import note
from engram.centre.store.database import first_row, rows_of
from engram.centre.store.schema import artifact_grants, artifacts, handins
from engram.centre.store.waking import ring
from engram.counts import counted
from engram.transfers import Manifest, WireManifest
from engram.transfers.manifest import decode_manifest, encode_manifest


def handin_id(name: str, robot: str, manifest: str) -> str:
    """The name of a hand-in, which both sides can compute."""
    return hashlib.sha256(f"{name} {robot} {manifest}".encode()).hexdigest()[:32]


class HandIns:
    """The hand-ins of a centre; `Parts` holds what they bring."""

    def __init__(self, centre: Centre) -> None:
        self._centre = centre

    def begin(self, name: str, robot: str, sent: WireManifest) -> dict[str, Any]:
        """Begins a hand-in, or finds it.

        Raises:
            InputError: the manifest is malformed, or continues one that is not known.
            QuotaError: the robot has too many open ones.
        """
        self._centre.map_row(name)
        base = None if sent.base is None else self._base(name, robot, sent.base)
        manifest = sent.full(base)
        key = handin_id(name, robot, manifest.id)
        now = self._centre.now_ns()
        with self._centre.database.reading() as connection:
            known = first_row(connection, select(handins).where(handins.c.id == key))
        if known is not None:
            return self._reopened(known)
        self._centre.objects.put(manifest_key(name, manifest.id), encode_manifest(manifest))
        row = {
            "id": key,
            "map": name,
            "robot": robot,
            "manifest": manifest.id,
            "base": sent.base,
            "content_hash": manifest.content_hash,
            "state": str(HandInState.OPEN),
            "begun_ns": now,
            "progress": "",
            **dict.fromkeys(("bytes", "tries", "cancelled", "ungated"), 0),
            **dict.fromkeys(("place", "ended_ns", "revision", "report", "error")),
        }
        with self._centre.database.writing() as connection:
            self._check_open(connection, name, robot)
            self._check_base(connection, name, sent.base)
            if self._centre.database.add(connection, handins, [row]):
                note(connection, now, robot, "hand-in", name, handin=key)
        return self.get(key)

    def _reopened(self, row: dict[str, Any]) -> dict[str, Any]:
        """An expired one, open again, without what it continued: that may be swept by now."""
        if row["state"] != HandInState.CANCELLED or row["cancelled"]:
            return row
        self.end(row, HandInState.OPEN, begun_ns=self._centre.now_ns(), base=None, error=None)
        return self.get(row["id"])

    def get(self, key: str) -> dict[str, Any]:
        """The row of a hand-in.

        Raises:
            UnknownError: there is none.
        """
        with self._centre.database.reading() as connection:
            row = first_row(connection, select(handins).where(handins.c.id == key))
        if row is None:
            raise UnknownError(f"there is no hand-in {key!r:.40}")
        return row

    def listed(
        self, name: str, robot: str | None, state: str | None, after: int, limit: int
    ) -> list[dict[str, Any]]:
        """Hand-ins of a map, newest first, that began before a time."""
        query = select(handins).where(handins.c.map == name, handins.c.begun_ns < after)
        if robot is not None:
            query = query.where(handins.c.robot == robot)
        if state is not None:
            query = query.where(handins.c.state == state)
        query = query.order_by(handins.c.begun_ns.desc(), handins.c.id).limit(limit)
        with self._centre.database.reading() as connection:
            return rows_of(connection, query)

    def complete(self, row: dict[str, Any]) -> dict[str, Any]:
        """Makes a hand-in a job; done twice it is the same.

        Raises:
            ConflictError: parts are missing.
        """
        if row["state"] != HandInState.OPEN:
            return row
        missing = Parts(self._centre).wanted(row)
        if missing:
            raise ConflictError(
                f"{counted(len(missing), 'part')} missing; ask which are wanted and send them"
            )
        now = self._centre.now_ns()
        with self._centre.database.writing() as connection:
            last = connection.execute(select(func.max(handins.c.place))).scalar() or 0
            changed = connection.execute(
                update(handins)
                .where(handins.c.id == row["id"], handins.c.state == str(HandInState.OPEN))
                .values(state=str(HandInState.COMPLETE), place=last + 1)
            )
            if changed.rowcount:
                note(connection, now, row["robot"], "complete", row["map"], handin=row["id"])
                ring(connection)
        return self.get(row["id"])

    def cancel(self, row: dict[str, Any], by: str) -> dict[str, Any]:
        """Asks for the end of a hand-in: at once where nothing works on it yet."""
        if row["state"] in ENDED:
            return row
        now = self._centre.now_ns()
        with self._centre.database.writing() as connection:
            change: dict[str, Any] = {"cancelled": 1}
            if row["state"] == HandInState.OPEN:
                change |= {"state": str(HandInState.CANCELLED), "ended_ns": now}
            connection.execute(update(handins).where(handins.c.id == row["id"]).values(**change))
            note(connection, now, by, "cancel", row["map"], handin=row["id"])
        return self.get(row["id"])

    def merge_anyway(self, row: dict[str, Any], by: str) -> dict[str, Any]:
        """Makes a refused, failed or cancelled hand-in a job again, without the gate.

        Raises:
            ConflictError: it is in another state.
        """
        if row["state"] not in ENDED - {HandInState.MERGED} or row["place"] is None:
            raise ConflictError(
                f"hand-in {row['id']} is {row['state']}; only a refused one is tried again"
            )
        again: dict[str, Any] = {
            "ungated": 1,
            "cancelled": 0,
            "tries": 0,
            "error": None,
            "ended_ns": None,
        }
        again["state"] = str(HandInState.COMPLETE)
        of_it = handins.c.id == row["id"]
        with self._centre.database.writing() as connection:
            connection.execute(update(handins).where(of_it).values(**again))
            now = self._centre.now_ns()
            note(connection, now, by, "merge-anyway", row["map"], handin=row["id"])
            ring(connection)
        return self.get(row["id"])

    def end(self, row: dict[str, Any], state: HandInState, **change: Any) -> None:
        """Ends a job, or opens it again; one transaction, with its event."""
        now = self._centre.now_ns()
        if "report" in change:
            change["report"] = json.dumps(change["report"])
        ended = now if state in ENDED else None
        if state == HandInState.OPEN:  # what it lacks is no death of a worker
            change["tries"] = 0
        with self._centre.database.writing() as connection:
            connection.execute(
                update(handins)
                .where(handins.c.id == row["id"])
                .values(state=str(state), ended_ns=ended, progress="", **change)
            )
            told = {
                key: change[key] for key in ("revision", "error") if change.get(key) is not None
            }
            note(connection, now, "worker", str(state), row["map"], handin=row["id"], **told)

    def begun(self, row: dict[str, Any]) -> None:
        """Counts a try, before it is made: what kills its worker is not tried for ever."""
        with self._centre.database.writing() as connection:
            connection.execute(
                update(handins).where(handins.c.id == row["id"]).values(tries=handins.c.tries + 1)
            )

    def put_off(self, row: dict[str, Any], why: str) -> None:
        """Takes back a try that found no room or no free lock: it is no fault of the hand-in."""
        change = {"tries": row["tries"], "progress": f"waits: {why}"}
        with self._centre.database.writing() as connection:
            connection.execute(update(handins).where(handins.c.id == row["id"]).values(**change))

    def heartbeat(self, key: str, progress: str) -> bool:
        """Notes how far a job is; whether it is to be cancelled."""
        with self._centre.database.writing(durable=False) as connection:
            connection.execute(update(handins).where(handins.c.id == key).values(progress=progress))
            asked = connection.execute(select(handins.c.cancelled).where(handins.c.id == key))
            return bool(asked.scalar())

    def expire(self) -> None:
        """Ends hand-ins that stayed incomplete too long."""
        limit_ns = self._centre.now_ns() - self._centre.settings.handin_days * DAY_NS
        query = select(handins).where(
            handins.c.state == str(HandInState.OPEN), handins.c.begun_ns < limit_ns
        )
        with self._centre.database.reading() as connection:
            old = rows_of(connection, query)
        for row in old:
            self.end(row, HandInState.CANCELLED, error="incomplete for too long")

    def waiting(self, name: str) -> list[dict[str, Any]]:
        """Jobs of a map, in the order of their completion."""
        query = (
            select(handins)
            .where(handins.c.map == name, handins.c.state == str(HandInState.COMPLETE))
            .order_by(handins.c.place)
        )
        with self._centre.database.reading() as connection:
            return rows_of(connection, query)

    def _base(self, name: str, robot: str, manifest: str) -> Manifest | None:
        """A manifest that the robot handed in to this map, or got from it; else None."""
        own = select(handins.c.manifest).where(
            handins.c.map == name,
            handins.c.robot == robot,
            handins.c.manifest == manifest,
            or_(
                handins.c.state == str(HandInState.MERGED),
                handins.c.state == str(HandInState.COMPLETE),
            ),
        )
        got = (
            select(artifacts.c.manifest)
            .join(artifact_grants, artifact_grants.c.artifact == artifacts.c.id)
            .where(
                artifacts.c.map == name,
                artifact_grants.c.subject == robot,
                artifacts.c.manifest == manifest,
            )
        )
        with self._centre.database.reading() as connection:
            if not (connection.execute(own).first() or connection.execute(got).first()):
                return None
        return decode_manifest(self._centre.objects.get(manifest_key(name, manifest)))

    def _check_base(self, connection: Connection, name: str, base: str | None) -> None:
        if base is not None and base not in needed_manifests(
            connection, name, kept_since_ns(self._centre)
        ):
            raise MalformedError(f"manifest {base:.40} is no longer kept; send a whole manifest")

    def _check_open(self, connection: Connection, name: str, robot: str) -> None:
        query = select(func.count()).where(
            handins.c.map == name,
            handins.c.robot == robot,
            handins.c.state == str(HandInState.OPEN),
        )
        count = connection.execute(query).scalar_one()
        if count >= self._centre.settings.open_handins:
            raise QuotaError(f"{counted(count, 'hand-in')} open; complete or cancel some")
