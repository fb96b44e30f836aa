"""Operations on whole map files: open, copy, rewrite, verify."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

from engram.errors import MapCorruptError
from engram.files import current_holder, map_path
from engram.maps.checking import check
from engram.maps.records import CheckReport, Problem
from engram.maps.sqlite import SqliteDatabase
from engram.maps.write_ahead import log_problems


def copy_map(source: Path, target: Path) -> None:
    """Copies the current state of a map file, even while another process writes to it.

    Raises:
        InputError: the target exists already, or its folder does not.
        MapError: the source cannot be read, or the target cannot be written.
    """
    with closing(SqliteDatabase(source)) as database:
        database.copy_to(target)


def compact_map(source: Path, target: Path) -> None:
    """Rewrites a map file with its rows in order and without gaps.

    The same rows in the same order give the same bytes, with one version of SQLite.

    Raises:
        InputError: the target exists already, or its folder does not.
        MapError: the source cannot be read, or the target cannot be written.
    """
    with closing(SqliteDatabase(source)) as database:
        database.compact_to(target)


def publish_map(draft: Path, target: Path) -> None:
    """Renames a map file that no process has open, within one file system.

    Raises:
        InputError: the target exists already, or its folder does not.
        MapError: the name cannot be given.
    """
    SqliteDatabase.publish(draft, target)


def check_file(location: Path | str, *, thin: bool = False) -> CheckReport:
    """Verifies every byte of a map file, even of one too damaged to open.

    Args:
        location: the map.
        thin: whether frames of nodes may be missing, as in a hand-in.

    Raises:
        NotAMapError: the file does not exist or is not a map.
        FormatVersionError: a newer Engram wrote it.
    """
    path = map_path(location)
    lost = _log_problems(path)
    try:
        database = SqliteDatabase(path)
    except MapCorruptError as error:
        return CheckReport((*lost, Problem("file", "", str(error))), 0, 0, (), 0)
    with closing(database):
        found = check(database, thin=thin)
    return replace(found, problems=(*lost, *found.problems))


def _log_problems(path: Path) -> list[Problem]:
    """Faults of a log that is not being written to."""
    path = path.resolve()
    if current_holder(path) is not None:
        return []
    return [Problem("file", "", fact) for fact in log_problems(path)]
