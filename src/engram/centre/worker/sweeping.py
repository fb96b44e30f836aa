"""Removes packs whose parts no hand-in and no download needs any more.

Kept are the parts of hand-ins that are under way or refused, of those that ended lately, of each
robot's newest merged one, which its next one continues, and of downloads. What was swept is
requested again where it is needed again: `wanted` lists it, as no robot counts as having sent it.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from typing import TypeAlias

from sqlalchemy import select

from engram.centre.keeping import ASKED, manifest_key, needed_manifests
from engram.centre.service import Centre, kept_since_ns
from engram.centre.settings import DAY_NS
from engram.centre.store.audit import note
from engram.centre.store.packs import written_ns
from engram.centre.store.schema import artifacts, packs
from engram.errors import EngramError, MapCorruptError
from engram.transfers import PartHash
from engram.transfers.join import blobs_named
from engram.transfers.manifest import decode_manifest

# Parts of manifests, by the manifest's hash.
_Marks: TypeAlias = dict[str, set[PartHash]]


def sweep_all(centre: Centre) -> None:
    """Sweeps every map that no other worker has; what hinders it is noted, and harms no hand-in."""
    for name in centre.map_names():
        with centre.lane(name) as is_ours:
            try:
                if is_ours:
                    sweep(centre, name)
            except EngramError as error:
                with centre.database.writing() as connection:
                    told = str(error)
                    note(connection, centre.now_ns(), "worker", "sweep-failed", name, error=told)


def sweep(centre: Centre, name: str) -> int:
    """Removes the packs of one map that nothing needs, and empties those that little is needed of.

    Uploads and downloads may continue: what is needed is looked up again in the transaction that
    forgets packs, and whoever stores parts looks in his whether those he found are still there.
    What was forgotten is deleted by the next sweep, so that readers and backups that looked before
    still find it.

    Args:
        centre: the centre.
        name: of the map.

    Returns:
        Bytes of the packs that are forgotten.
    """
    _delete_forgotten(centre, name)
    limit_ns, store = kept_since_ns(centre), centre.packs(name)
    marks: _Marks = {}
    with centre.database.reading() as connection:
        manifests = needed_manifests(connection, name, limit_ns)
    _mark(centre, name, manifests, marks)
    with centre.database.writing() as connection:
        making = select(artifacts.c.id).where(artifacts.c.map == name, artifacts.c.state == ASKED)
        if connection.execute(making).first() is not None:
            return 0  # its parts are found or stored now, and not yet named by a manifest
        manifests = needed_manifests(connection, name, limit_ns)
        _mark(centre, name, manifests, marks)
        needed = set[PartHash]().union(*(marks[one] for one in manifests))
        gone = store.little_needed(connection, needed, limit_ns)
        size = sum(store.forget(connection, pack, kept, centre.now_ns()) for pack, kept in gone)
        if gone:
            note(connection, centre.now_ns(), "worker", "sweep", name, packs=len(gone), bytes=size)
    return size


def _mark(centre: Centre, name: str, manifests: Iterable[str], marks: _Marks) -> None:
    """Adds the parts of manifests that are not marked yet, as far as they are there."""
    store = centre.packs(name)
    for one in manifests:
        if one in marks:
            continue
        manifest = decode_manifest(centre.objects.get(manifest_key(name, one)))
        pages = dict(store.read(dict.fromkeys(manifest.hashes())))
        marks[one] = set(pages)
        here = {
            table: tuple(page for page in some if page in pages)
            for table, some in manifest.pages.items()
        }
        with suppress(MapCorruptError):  # a stranger's page: its hand-in fails by itself
            for _, _, blobs in blobs_named(replace(manifest, pages=here), pages.get):
                marks[one].update(blobs)


def _delete_forgotten(centre: Centre, name: str) -> None:
    """Deletes packs that no row names: forgotten by the sweep before, or left by a kill."""
    limit_ns = min(kept_since_ns(centre), centre.now_ns() - DAY_NS)
    keys = [key.rsplit("/", 1)[1] for key in centre.objects.keys(f"packs/{name}")]
    with centre.database.reading() as connection:
        known = set(connection.execute(select(packs.c.id).where(packs.c.map == name)).scalars())
    for one in keys:
        if one not in known and written_ns(one) <= limit_ns:
            centre.objects.delete(f"packs/{name}/{one}")
