"""Backups of an embedded centre, made while it runs."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from engram.centre.service import Centre
from engram.centre.store.objects import FolderObjects
from engram.errors import ConfigError, InputError
from engram.maps import Map, copy_map


def back_up(centre: Centre, target: Path) -> dict[str, int]:
    """Copies a centre into a new folder, which `engram centre serve` opens.

    The tables come first: what maps hold beyond them is merged again and changes nothing. Packs and
    manifests never change, so that they may come last.

    Returns:
        The revision of each map that the copy holds: robots may forget what led to it.

    Raises:
        InputError: the folder exists.
        ConfigError: the tables are not in the folder.
    """
    if any(centre.addresses):
        raise ConfigError(
            "only a centre that is kept in a folder is copied; back up PostgreSQL and the "
            "bucket with their own tools"
        )
    if target.exists():
        raise InputError(f"{target} exists already; choose another name")
    (target / "maps").mkdir(parents=True)
    source = sqlite3.connect(centre.folder / "centre.sqlite")
    copy = sqlite3.connect(target / "centre.sqlite")
    with closing(source), closing(copy):
        source.backup(copy)
    held = {}
    for name in centre.map_names():
        path = target / "maps" / f"{name}.engram"
        copy_map(centre.map_path(name), path)
        with Map.open(path) as store:
            held[name] = store.revision
    objects = FolderObjects(target / "objects")
    for prefix in ("packs", "manifests"):
        for key in centre.objects.keys(prefix):
            objects.put(key, centre.objects.get(key))
    for name, revision in held.items():
        centre.set_durable(name, revision, "backup")
    return held
