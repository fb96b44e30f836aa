"""Backups of a centre, made while it runs."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from engram.centre.service import Centre
from engram.centre.store.objects import FolderObjects, sync_folder
from engram.errors import InputError, MapError, StorageFullError
from engram.files import draft_folder
from engram.maps import Map, copy_map
from engram.sqlite import is_full


def back_up(centre: Centre, target: Path) -> dict[str, int]:
    """Copies what a centre has in its folder into a new one, which `engram centre serve` opens.

    The new folder appears whole or not at all: half a backup would lose what robots forget.

    The tables come first: what maps hold beyond them is merged again and changes nothing. Packs and
    manifests never change, so that they may come last. Tables in PostgreSQL and a bucket are to be
    copied with their own tools before this, since robots forget what it holds.

    Returns:
        The revision of each map that the copy holds: robots may forget what led to it.

    Raises:
        InputError: the folder exists or cannot be made, or the tables name no map.
        StorageFullError: it does not fit there.
    """
    if target.exists():
        raise InputError(f"{target} exists already; choose another name")
    names = centre.map_names()
    if not names:
        raise InputError(
            f"{centre.folder} has no maps in its tables; if PostgreSQL has them, give --database"
        )
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{target} cannot hold a backup: {error.strerror}") from error
    with draft_folder(target) as folder:
        draft = folder / "copy"
        held = _copied(centre, draft, names)
        draft.rename(target)
        sync_folder(target.parent)
    for name, revision in held.items():
        centre.set_durable(name, revision, "backup")
    return held


def _copied(centre: Centre, draft: Path, names: list[str]) -> dict[str, int]:
    database, bucket = centre.addresses
    (draft / "maps").mkdir(parents=True)
    if database is None:
        _copy_tables(centre.folder / "centre.sqlite", draft / "centre.sqlite")
    held = {}
    for name in names:
        path = draft / "maps" / f"{name}.engram"
        copy_map(centre.map_path(name), path)
        with Map.open(path) as store:
            held[name] = store.revision
    objects = FolderObjects(draft / "objects")
    for prefix in ("packs", "manifests") if bucket is None else ():
        for key in centre.objects.keys(prefix):
            objects.put(key, centre.objects.get(key))
    return held


def _copy_tables(path: Path, copy: Path) -> None:
    try:
        with closing(sqlite3.connect(path)) as source, closing(sqlite3.connect(copy)) as target:
            source.backup(target)
    except sqlite3.Error as error:
        kind = StorageFullError if is_full(error) else MapError
        raise kind(f"the tables cannot be copied to {copy}: {error}") from error
