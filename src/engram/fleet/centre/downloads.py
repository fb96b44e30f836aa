"""Downloads: what a mission needs of a map, as an artifact of the centre."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator
from typing import Any, TypedDict, get_type_hints

import msgspec
from sqlalchemy import delete, update

from engram.config import to_dict
from engram.errors import ConfigError, EngramError, StorageFullError
from engram.fleet.centre import jobs
from engram.fleet.centre.database import note
from engram.fleet.centre.fleet import revision_of, version_of
from engram.fleet.centre.problems import ConflictError, StoreError
from engram.fleet.centre.service import DAY_NS, Centre, manifest_key
from engram.fleet.centre.tables import (
    Artifact,
    ArtifactGrant,
    JobState,
    artifact_grants,
    artifacts,
)
from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.transfers import (
    Manifest,
    PartHash,
    blobs_named,
    decode_manifest,
    encode_manifest,
    split,
)

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


def ask(centre: Centre, name: str, subject: str, ref: str, options: DownloadOptions) -> Artifact:
    """Asks for a download; with the same revision and options it is the same artifact."""
    revision, now, values = revision_of(centre, name, ref), centre.now_ns(), to_dict(options)
    wanted = json.dumps(values, sort_keys=True)
    about = f"{name} {version_of(centre, name, revision)} {wanted}"
    row = Artifact(
        id=hashlib.sha256(about.encode()).hexdigest()[:32],
        map=name,
        revision=revision,
        options=values,
        state=JobState.ASKED,
        asked_ns=now,
        used_ns=now,
    )
    with centre.database.writing() as connection:
        jobs.ask(centre, connection, row, subject, "download", revision=revision)
        centre.database.add(connection, ArtifactGrant(row.id, subject))
        connection.execute(update(artifacts).where(artifacts.c.id == row.id).values(used_ns=now))
    return jobs.get(centre, Artifact, row.id)


def is_granted(centre: Centre, key: str, subject: str) -> bool:
    """Whether a person or robot requested an artifact."""
    of_both = (artifact_grants.c.artifact == key, artifact_grants.c.subject == subject)
    return centre.database.row(ArtifactGrant, *of_both) is not None


def ready(centre: Centre, row: Artifact) -> Manifest:
    """The manifest of an artifact.

    Raises:
        ConflictError: it is not ready.
    """
    if row.state != JobState.READY or row.manifest is None:
        raise ConflictError(f"artifact {row.id} is {row.state}: {row.error or 'wait'}")
    return decode_manifest(centre.objects.get(manifest_key(row.map, row.manifest)))


def parts_of(centre: Centre, row: Artifact, wanted: list[PartHash]) -> Iterator[bytes]:
    """The requested parts that belong to the artifact."""
    manifest, packs = ready(centre, row), centre.packs(row.map)
    own = set(manifest.hashes())
    if any(part not in own for part in wanted):
        read = dict(packs.read(own))
        for _, _, blobs in blobs_named(manifest, read.get):
            own.update(blobs)
    for _, body in packs.read([part for part in wanted if part in own]):
        yield body


def file_key(row: Artifact) -> str:
    """Where the whole file is kept among the objects, for clients that handle only files."""
    return f"artifacts/{row.map}/{row.id}.engram"


def expire(centre: Centre) -> None:
    """Removes artifacts that were not used for long; the next request makes them again."""
    now = centre.now_ns()
    limit_ns = now - centre.settings.artifact_days * DAY_NS
    old = (artifacts.c.used_ns < limit_ns, artifacts.c.state != JobState.ASKED)
    for row in centre.database.rows(Artifact, *old):
        with centre.database.writing() as connection:
            of_row = artifact_grants.c.artifact == row.id
            connection.execute(delete(artifact_grants).where(of_row))
            connection.execute(delete(artifacts).where(artifacts.c.id == row.id))
            note(connection, now, jobs.WORKER, "expired", row.map, artifact=row.id)
        centre.objects.delete(file_key(row))


def make(centre: Centre, row: Artifact) -> None:
    """Makes an artifact; done twice, or half done before, it is the same.

    Raises:
        StorageFullError, StoreError: the centre has no room for it now, and makes it later.
    """
    try:
        manifest, report = _made(centre, row)
    except (StorageFullError, StoreError):
        raise
    except EngramError as error:
        jobs.set_state(centre, row, JobState.FAILED, error=centre.words_of(error))
    except Exception as error:  # of what a stranger handed in: it ends this download alone
        _log.exception("%s: download %s", row.map, row.id)
        jobs.set_state(centre, row, JobState.FAILED, error=centre.fault_of(error))
    else:
        jobs.set_state(centre, row, JobState.READY, manifest=manifest, report=report)


def _made(centre: Centre, row: Artifact) -> tuple[str, dict[str, Any]]:
    """Its manifest and its report."""
    path = centre.folder / "work" / f"{row.id}.engram"
    path.unlink(missing_ok=True)
    try:
        options = options_of(row.options)
        report = download(centre.map_path(row.map), path, options, at=row.revision)
        taken = split(path)
        centre.packs(row.map).add_split(taken, centre.now_ns)
        manifest = encode_manifest(taken.manifest)
        centre.objects.put(manifest_key(row.map, taken.manifest.id), manifest)
        centre.objects.put_file(file_key(row), path)
    finally:
        path.unlink(missing_ok=True)
    shown = {key: value for key, value in report.to_dict().items() if key != "out"}
    return taken.manifest.id, shown
