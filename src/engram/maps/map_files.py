"""Map files as a whole: opened, copied, written anew, verified."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from engram.errors import MapCorruptError
from engram.maps.checking import check
from engram.maps.database import Database, Place
from engram.maps.records import CheckReport, Problem
from engram.maps.sqlite import SqliteDatabase, map_path


def open_database(location: Path | str | Place) -> Database:
    """The database of an existing map."""
    if isinstance(location, Path | str):
        return SqliteDatabase(map_path(location))
    return location.open()


def copy_map(source: Path, target: Path) -> None:
    """Copies a map file as it is now, also while somebody writes to it.

    Raises:
        InputError: the target exists already, or its folder does not.
        MapError: the source cannot be read, or the target not written.
    """
    with closing(SqliteDatabase(source)) as database:
        database.copy_to(target)


def compact_map(source: Path, target: Path) -> None:
    """Writes a map file anew, its rows in order and without gaps.

    The same rows written in the same order give the same bytes, with one version of SQLite.

    Raises:
        InputError: the target exists already, or its folder does not.
        MapError: the source cannot be read, or the target not written.
    """
    with closing(SqliteDatabase(source)) as database:
        database.compact_to(target)


def publish_map(draft: Path, target: Path) -> None:
    """Gives a map file that nobody has open its name, in the same file system: last of all.

    Raises:
        InputError: the target exists already, or its folder does not.
        MapError: the name cannot be given.
    """
    SqliteDatabase.publish(draft, target)


def check_file(location: Path | str | Place) -> CheckReport:
    """Verify a map file to the last byte, also one that is too damaged to open.

    Raises:
        NotAMapError: nothing is there, or something else.
        FormatVersionError: a newer Engram wrote it.
    """
    try:
        database = open_database(location)
    except MapCorruptError as error:
        return CheckReport((Problem("file", "", str(error)),), 0, 0, (), 0)
    with closing(database):
        return check(database)
