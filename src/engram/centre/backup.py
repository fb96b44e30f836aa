"""Backups of a centre, made while it runs."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from engram.centre.service import Centre
from engram.centre.store.objects import FolderObjects
from engram.errors import InputError
from engram.maps import Map, copy_map


def back_up(centre: Centre, target: Path) -> dict[str, int]:
    """Copies what a centre has in its folder into a new one, which `engram centre serve` opens.

    The tables come first: what maps hold beyond them is merged again and changes nothing. Packs and
    manifests never change, so that they may come last. Tables in PostgreSQL and a bucket are to be
    copied with their own tools before this, since robots forget what it holds.

    Returns:
        The revision of each map that the copy holds: robots may forget what led to it.

    Raises:
        InputError: the folder exists or cannot be made, or the tables name no map.
    """
    if target.exists():
        raise InputError(f"{target} exists already; choose another name")
    names, (database, bucket) = centre.map_names(), centre.addresses
    if not names:
        raise InputError(
            f"{centre.folder} has no maps in its tables; if PostgreSQL has them, give --database"
        )
    try:
        (target / "maps").mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{target} cannot hold a backup: {error.strerror}") from error
    if database is None:
        source = sqlite3.connect(centre.folder / "centre.sqlite")
        copy = sqlite3.connect(target / "centre.sqlite")
        with closing(source), closing(copy):
            source.backup(copy)
    held = {}
    for name in names:
        path = target / "maps" / f"{name}.engram"
        copy_map(centre.map_path(name), path)
        with Map.open(path) as store:
            held[name] = store.revision
    objects = FolderObjects(target / "objects")
    for prefix in ("packs", "manifests") if bucket is None else ():
        for key in centre.objects.keys(prefix):
            objects.put(key, centre.objects.get(key))
    for name, revision in held.items():
        centre.set_durable(name, revision, "backup")
    return held
