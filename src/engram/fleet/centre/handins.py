"""Hand-ins: from a manifest and its parts to a job.

A hand-in is its manifest, of one robot, on one map: begun twice it is the same. A part is its hash.
A complete hand-in's row is the job; there is no other queue.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from typing import Any

from sqlalchemy import Connection, func, or_, select, update

from engram.counts import counted
from engram.errors import InputError, MapCorruptError
from engram.fleet.centre.database import (
    artifact_grants,
    artifacts,
    first_row,
    handins,
    note,
    ring,
    rows_of,
    usage,
)
from engram.fleet.centre.errors import (
    ConflictError,
    MalformedError,
    MissingPartsError,
    QuotaError,
    UnknownError,
)
from engram.fleet.centre.objects import given_by
from engram.fleet.centre.service import (
    DAY_NS,
    ENDED,
    Centre,
    HandInState,
    kept_since_ns,
    manifest_key,
    needed_manifests,
)
from engram.fleet.transfers import (
    Manifest,
    PartHash,
    WireManifest,
    decode_manifest,
    decode_page,
    encode_manifest,
)
from engram.maps.schema import frames, nodes, vocabularies


class Parts:
    """The manifests and parts of a centre's hand-ins; `HandIns` holds their rows."""

    def __init__(self, centre: Centre) -> None:
        self._centre = centre

    def manifest(self, row: dict[str, Any]) -> Manifest:
        """The manifest of a hand-in."""
        key = manifest_key(row["map"], row["manifest"])
        return decode_manifest(self._centre.objects.get(key))

    def base_of(self, row: dict[str, Any]) -> Manifest:
        """The manifest that it continues; an empty one without."""
        if row["base"] is None:
            return Manifest("", 0, {})
        return decode_manifest(self._centre.objects.get(manifest_key(row["map"], row["base"])))

    def put(self, row: dict[str, Any], some: Sequence[bytes]) -> None:
        """Stores verified parts of a hand-in; those that are there already cost nothing.

        Raises:
            ConflictError: it is complete or has ended.
            InputError: it is larger than any may be.
            QuotaError: more than the robot may hand in today.
        """
        if row["state"] != HandInState.OPEN:
            raise ConflictError(f"hand-in {row['id']} is {row['state']} and takes no more parts")
        size, now = sum(map(len, some)), self._centre.now_ns()
        with self._centre.database.reading() as connection:
            used = _used(connection, row["robot"], now)
            whole = first_row(connection, select(handins.c.bytes).where(handins.c.id == row["id"]))
        limits = self._centre.settings
        if used + size > limits.bytes_a_day:
            raise QuotaError(
                f"{used + size} bytes today; {limits.bytes_a_day} are granted: continue tomorrow"
            )
        if whole is not None and whole["bytes"] + size > limits.handin_bytes:
            raise InputError(
                f"the hand-in is larger than {limits.handin_bytes} bytes; hand in more often"
            )
        new = self._centre.packs(row["map"]).add(some, now, row["robot"])
        with self._centre.database.writing(durable=False) as connection:
            connection.execute(
                update(handins).where(handins.c.id == row["id"]).values(bytes=handins.c.bytes + new)
            )
            used = _used(connection, row["robot"], now) + new
            day = {"subject": row["robot"], "day": now // DAY_NS, "bytes": used}
            self._centre.database.put(connection, usage, day)

    def wanted(self, row: dict[str, Any]) -> list[PartHash]:
        """Parts that the robot has yet to send: pages first, then the blobs that they name.

        Of frames only those of nodes that are new to the fleet map; it takes no others.
        """
        if row["state"] != HandInState.OPEN:
            return []
        manifest, base = self.manifest(row), set(self.base_of(row).hashes())
        fresh = [one for one in dict.fromkeys(manifest.hashes()) if one not in base]
        lacking = self._not_given(row, fresh)
        if lacking:
            return lacking
        new = set(fresh)
        named = self.blobs_needed(row, manifest, new)
        return self._not_given(row, list(dict.fromkeys(named)))

    def blobs_needed(
        self, row: dict[str, Any], manifest: Manifest, pages: set[PartHash] | None = None
    ) -> list[PartHash]:
        """Blobs that merging reads.

        Args:
            row: the hand-in.
            manifest: its manifest.
            pages: only blobs that these pages name; None for all.

        Raises:
            MalformedError: a page does not hold rows of its table.
        """
        packs = self._centre.packs(row["map"])

        def rows(name: str, some: set[PartHash] | None) -> Iterable[tuple[Any, ...]]:
            table = {"nodes": nodes, "frames": frames, "vocabularies": vocabularies}[name]
            wanted = [one for one in manifest.pages.get(name, ()) if some is None or one in some]
            for _, body in packs.read(wanted):
                try:
                    yield from decode_page(table, body)
                except MapCorruptError as error:
                    raise MalformedError(str(error)) from error

        own = {one[1]: one[0] for one in rows("nodes", None)}
        with self._centre.reading(row["map"]) as store:
            held = {own[uuid] for uuid in store.known_among(list(own))}
        found = []
        for one in rows("frames", pages):
            if one[0] not in held:
                found += [PartHash(blob) for blob in one[2:4] if blob is not None]
        return found + [PartHash(one[3]) for one in rows("vocabularies", pages)]

    def source(self, row: dict[str, Any], manifest: Manifest) -> dict[PartHash, bytes]:
        """Pages and blobs of a hand-in that it may use: given by its robot, or of its base."""
        base = self.base_of(row)
        pages = list(dict.fromkeys(manifest.hashes()))
        trusted = set(base.hashes())
        self._refuse_foreign(row, [one for one in pages if one not in trusted])
        blobs = self.blobs_needed(row, manifest)
        of_base = set(self.blobs_needed(row, base)) if base.pages else set()
        self._refuse_foreign(row, [one for one in blobs if one not in of_base])
        return dict(self._centre.packs(row["map"]).read([*pages, *dict.fromkeys(blobs)]))

    def _refuse_foreign(self, row: dict[str, Any], some: list[PartHash]) -> None:
        lacking = self._not_given(row, some)
        if lacking:
            raise MissingPartsError(f"{counted(len(lacking), 'part')} missing")

    def _not_given(self, row: dict[str, Any], some: list[PartHash]) -> list[PartHash]:
        with self._centre.database.reading() as connection:
            had = given_by(connection, row["map"], row["robot"], some)
        return [one for one in some if one not in had]


def _used(connection: Connection, robot: str, now_ns: int) -> int:
    query = select(usage.c.bytes).where(usage.c.subject == robot, usage.c.day == now_ns // DAY_NS)
    return connection.execute(query).scalar() or 0


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
