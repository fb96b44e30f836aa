"""Jobs of a centre: downloads for missions, and dreams of a better map.

Dreams: jobs that look for a better map in what robots handed in. A dream is what is handed in, how
it is merged and what judges it: each is dreamt of once.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator
from contextlib import closing, suppress
from typing import Any, TypedDict, get_type_hints

import msgspec
from sqlalchemy import delete, select, update

from engram.config import to_dict
from engram.counts import counted
from engram.errors import ConfigError, EngramError, StorageFullError
from engram.fleet.centre.database import (
    artifact_grants,
    artifacts,
    dreams,
    first_row,
    handins,
    note,
    ring,
    rows_of,
)
from engram.fleet.centre.errors import ConflictError, StoreError, UnknownError
from engram.fleet.centre.fleet import Refs
from engram.fleet.centre.handins import Parts
from engram.fleet.centre.objects import PACK_BYTES, given_by
from engram.fleet.centre.service import (
    ASKED,
    CANCELLED,
    DAY_NS,
    DONE,
    FAILED,
    READY,
    Centre,
    log_of,
    newest_merged,
)
from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.dream import FEWEST_DRIVES
from engram.fleet.transfers import (
    Manifest,
    PartHash,
    blobs_named,
    decode_manifest,
    decode_page,
    encode_manifest,
    part_hash,
    split,
)
from engram.maps.exchange import MapRows
from engram.maps.schema import frames, nodes

_log = logging.getLogger(__name__)
_OPTIONS = TypedDict("_OPTIONS", get_type_hints(DownloadOptions), total=False)  # type: ignore[misc]


def options_of(values: dict[str, Any]) -> DownloadOptions:
    """Options of a download from plain values.

    Raises:
        ConfigError: one is unknown, of the wrong type, or out of range.
    """
    known = get_type_hints(DownloadOptions)
    if unknown := sorted(values.keys() - known.keys()):
        raise ConfigError(f"unknown options {unknown!r:.80}; known: {', '.join(known)}")
    try:
        return DownloadOptions(**msgspec.convert(values, _OPTIONS))
    except msgspec.ValidationError as error:
        raise ConfigError(f"options: {error}") from error


class Downloads:
    """The artifacts of a centre."""

    def __init__(self, centre: Centre) -> None:
        self._centre = centre

    def ask(self, name: str, subject: str, ref: str, options: DownloadOptions) -> dict[str, Any]:
        """Asks for a download; with the same revision and options it is the same artifact."""
        revision = Refs(self._centre).revision(name, ref)
        version = Refs(self._centre).version(name, revision)
        asked = json.dumps(to_dict(options), sort_keys=True)
        key = hashlib.sha256(f"{name} {version} {asked}".encode()).hexdigest()[:32]
        now = self._centre.now_ns()
        row = {
            "id": key,
            "map": name,
            "revision": revision,
            "options": asked,
            "state": ASKED,
            "manifest": None,
            "report": None,
            "error": None,
            "asked_ns": now,
            "used_ns": now,
        }
        with self._centre.database.writing() as connection:
            if self._centre.database.add(connection, artifacts, [row]):
                note(connection, now, subject, "download", name, artifact=key, revision=revision)
                ring(connection)
            grant = {"artifact": key, "subject": subject}
            self._centre.database.add(connection, artifact_grants, [grant])
            connection.execute(update(artifacts).where(artifacts.c.id == key).values(used_ns=now))
        return self.get(key)

    def get(self, key: str) -> dict[str, Any]:
        """The row of an artifact.

        Raises:
            UnknownError: there is none.
        """
        with self._centre.database.reading() as connection:
            row = first_row(connection, select(artifacts).where(artifacts.c.id == key))
        if row is None:
            raise UnknownError(f"there is no artifact {key!r:.40}")
        return row

    def is_granted(self, key: str, subject: str) -> bool:
        """Whether a person or robot requested an artifact."""
        query = select(artifact_grants).where(
            artifact_grants.c.artifact == key, artifact_grants.c.subject == subject
        )
        with self._centre.database.reading() as connection:
            return connection.execute(query).first() is not None

    def ready(self, row: dict[str, Any]) -> Manifest:
        """The manifest of an artifact.

        Raises:
            ConflictError: it is not ready.
        """
        if row["state"] != READY:
            raise ConflictError(f"artifact {row['id']} is {row['state']}: {row['error'] or 'wait'}")
        key = f"manifests/{row['map']}/{row['manifest']}"
        return decode_manifest(self._centre.objects.get(key))

    def parts(self, row: dict[str, Any], wanted: list[PartHash]) -> Iterator[bytes]:
        """The requested parts that belong to the artifact."""
        manifest, packs = self.ready(row), self._centre.packs(row["map"])
        pages = set(manifest.hashes())
        if any(one not in pages for one in wanted):
            read = dict(packs.read(pages))
            for _, _, blobs in blobs_named(manifest, read.get):
                pages.update(blobs)
        for _, body in packs.read([one for one in wanted if one in pages]):
            yield body

    def file_key(self, row: dict[str, Any]) -> str:
        """Path of the whole file, for clients that handle only files."""
        self.ready(row)
        return f"artifacts/{row['map']}/{row['id']}.engram"

    def asked(self) -> list[dict[str, Any]]:
        """Artifacts that are to be made, oldest first."""
        query = select(artifacts).where(artifacts.c.state == ASKED).order_by(artifacts.c.asked_ns)
        with self._centre.database.reading() as connection:
            return rows_of(connection, query)

    def expire(self) -> None:
        """Removes artifacts that were not used for long; the next request makes them again."""
        limit_ns = self._centre.now_ns() - self._centre.settings.artifact_days * DAY_NS
        query = select(artifacts).where(artifacts.c.used_ns < limit_ns, artifacts.c.state != ASKED)
        with self._centre.database.reading() as connection:
            old = rows_of(connection, query)
        for row in old:
            with self._centre.database.writing() as connection:
                for table in (artifact_grants, artifacts):
                    column = table.c.artifact if table is artifact_grants else table.c.id
                    connection.execute(delete(table).where(column == row["id"]))
                now = self._centre.now_ns()
                note(connection, now, "worker", "expired", row["map"], artifact=row["id"])
            self._centre.objects.delete(f"artifacts/{row['map']}/{row['id']}.engram")

    def make(self, row: dict[str, Any]) -> None:
        """Makes an artifact; done twice, or half done before, it is the same.

        Raises:
            StorageFullError, StoreError: the centre has no room for it now, and makes it later.
        """
        try:
            change = self._made(row)
        except (StorageFullError, StoreError):
            raise
        except EngramError as error:
            change = {"state": FAILED, "error": self._centre.words_of(error)}
        except Exception as error:  # of what a stranger handed in: it ends this download alone
            _log.exception("%s: download %s", row["map"], row["id"])
            change = {"state": FAILED, "error": self._centre.fault_of(error)}
        with self._centre.database.writing() as connection:
            connection.execute(
                update(artifacts).where(artifacts.c.id == row["id"]).values(**change)
            )
            now = self._centre.now_ns()
            why = {"error": change["error"]} if "error" in change else {}
            note(connection, now, "worker", change["state"], row["map"], artifact=row["id"], **why)

    def _made(self, row: dict[str, Any]) -> dict[str, Any]:
        centre = self._centre
        path = centre.folder / "work" / f"{row['id']}.engram"
        path.unlink(missing_ok=True)
        options = options_of(json.loads(row["options"]))
        try:
            report = download(centre.map_path(row["map"]), path, options, at=row["revision"])
            taken = split(path)
            packs = centre.packs(row["map"])
            names = packs.lacking([*taken.pages, *taken.blobs])
            batch, size = [], 0
            for body in taken.parts(names):
                batch.append(body)
                size += len(body)
                if size >= PACK_BYTES:
                    packs.add(batch, centre.now_ns())
                    batch, size = [], 0
            packs.add(batch, centre.now_ns())
            manifest = encode_manifest(taken.manifest)
            centre.objects.put(f"manifests/{row['map']}/{taken.manifest.id}", manifest)
            centre.objects.put_file(f"artifacts/{row['map']}/{row['id']}.engram", path)
        finally:
            path.unlink(missing_ok=True)
        told = {key: value for key, value in report.to_dict().items() if key != "out"}
        return {"state": READY, "manifest": taken.manifest.id, "report": json.dumps(told)}


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
