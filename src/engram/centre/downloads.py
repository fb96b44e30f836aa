"""Downloads: what a mission needs, made once for each revision and options."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator
from typing import Any, TypedDict, get_type_hints

import msgspec
from sqlalchemy import delete, select, update

from engram.centre.errors import ConflictError, StoreError, UnknownError
from engram.centre.keeping import ASKED, FAILED, READY
from engram.centre.refs import Refs
from engram.centre.service import Centre
from engram.centre.settings import DAY_NS
from engram.centre.store.audit import note
from engram.centre.store.database import first_row, rows_of
from engram.centre.store.packs import PACK_BYTES
from engram.centre.store.schema import artifact_grants, artifacts
from engram.centre.store.waking import ring
from engram.config import to_dict
from engram.errors import ConfigError, EngramError, StorageFullError
from engram.fleet.download import DownloadOptions, download
from engram.transfers import Manifest, PartHash, split
from engram.transfers.join import blobs_named
from engram.transfers.manifest import decode_manifest, encode_manifest

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
