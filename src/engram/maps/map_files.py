"""The files of a map: copies, and damage in a write-ahead log.

Damage in a write-ahead log, which SQLite takes for the log's end without a word. Frames of a log
chain their checksums. SQLite reads up to the first that does not fit, so a damaged frame loses what
was committed after it. A log that ends early is an earlier state of its map, and a writer that is
killed may leave one unfinished frame; both are sound. A power cut may leave the last commit in
parts; it had not finished, since a commit is synced before it returns and before the next begins.

Source: SQLite, "WAL-mode File Format".
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from engram.errors import InputError, MapCorruptError
from engram.files import current_holder, map_path
from engram.maps.checking import check
from engram.maps.records import CheckReport, Problem
from engram.maps.sqlite import SqliteDatabase
from engram.maps.tags import resolve
from engram.untrusted import open_regular

_HEADER, _FRAME_HEAD = 32, 24
# Byte order of the words of checksums, by the log's first bytes.
_ORDERS = {b"\x37\x7f\x06\x82": "<u4", b"\x37\x7f\x06\x83": ">u4"}
_SALTS = slice(16, 24)
_SUMMED = 24  # bytes of the header that its checksum covers
_MASK = 0xFFFFFFFF
# Logs begun since a frame that was written over, at most; each raises the first salt by one.
_GENERATIONS = 2**20


@dataclass(frozen=True, slots=True)
class LogDamage:
    """What is wrong with a log.

    Attributes:
        fact: it, with the log's name.
        lost: whether something that was committed is lost for certain.
    """

    fact: str
    lost: bool


def log_damage(path: Path) -> LogDamage | None:
    """Damage in the log of a database without a writer; None if there is no log, or no damage.

    Args:
        path: the database. Neither it nor its log is opened by SQLite yet, which would fold the
            log into the file up to its first damaged frame.

    Raises:
        InputError: the log cannot be read.
    """
    log = path.with_name(f"{path.name}-wal")
    if not log.exists():
        return None
    with os.fdopen(open_regular(log, InputError), "rb") as file:
        found = _damage(file)
    return None if found is None else replace(found, fact=f"{log.name}: {found.fact}")


def _lost(fact: str) -> LogDamage:
    return LogDamage(f"{fact}; what was written after it is lost", lost=True)


def _damage(file: BinaryIO) -> LogDamage | None:
    header = file.read(_HEADER)
    if len(header) < _HEADER:
        return None  # empty, or its writer was killed before the first frame
    page = int.from_bytes(header[8:12], "big")
    order = _ORDERS.get(header[:4])
    if order is None or not 512 <= page <= 65_536 or page & (page - 1):
        return _lost("its header is damaged")
    if _sum(header[:_SUMMED], (0, 0), order) != _stored(header, _SUMMED):
        return _lost("its header does not match its checksum")
    return _frame_damage(file, header, page, order)


def _frame_damage(file: BinaryIO, header: bytes, page: int, order: str) -> LogDamage | None:
    summed = _stored(header, _SUMMED)
    for number in itertools.count(1):
        head, content = file.read(_FRAME_HEAD), file.read(page)
        if len(content) < page:
            return None
        ours = head[8:16] == header[_SALTS]
        if ours:
            summed = _sum(content, _sum(head[:8], summed, order), order)
            if summed == _stored(head, 16):
                continue
        rest = [head] if ours else []
        rest += _further(file, header, page)
        if not (ours or rest) and _is_older(head, header):
            return None
        if sum(map(_commits, rest)) <= 1:
            return LogDamage(
                f"its last commit is not whole from frame {number} on: if the power was cut, it "
                "had not finished; otherwise it is lost",
                lost=False,
            )
        fact = "does not match its checksum" if ours else "is of another log"
        return _lost(f"frame {number} {fact}")
    raise AssertionError


def _commits(head: bytes) -> bool:
    """Whether a frame is the last one of a commit."""
    return any(head[4:8])


def _is_older(head: bytes, header: bytes) -> bool:
    """Whether a frame was left by a log that this one was written over."""
    ours, its = (int.from_bytes(one, "big") for one in (header[16:20], head[8:12]))
    return 1 <= (ours - its) & _MASK <= _GENERATIONS


def _further(file: BinaryIO, header: bytes, page: int) -> Iterator[bytes]:
    """Heads of this log's frames from here on."""
    while len(head := file.read(_FRAME_HEAD)) == _FRAME_HEAD:
        if head[8:16] == header[_SALTS]:
            yield head
        file.seek(page, os.SEEK_CUR)


def _stored(body: bytes, at: int) -> tuple[int, int]:
    return int.from_bytes(body[at : at + 4], "big"), int.from_bytes(body[at + 4 : at + 8], "big")


def _sum(body: bytes, before: tuple[int, int], order: str) -> tuple[int, int]:
    """SQLite's checksum of an even number of words: s0 += x0 + s1, s1 += x1 + s0."""
    s0, s1 = before
    words = np.frombuffer(body, order).tolist()
    for even, odd in zip(words[::2], words[1::2], strict=True):
        s0 = (s0 + even + s1) & _MASK
        s1 = (s1 + odd + s0) & _MASK
    return s0, s1


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


def check_file(
    location: Path | str, *, thin: bool = False, since: int | str | None = None
) -> CheckReport:
    """Verifies every byte of a map file, even of one too damaged to open.

    Args:
        location: the map.
        thin: whether frames of nodes may be missing, as in a hand-in.
        since: number or name of the revision after which rows are verified; None for all of them,
            and the structure of the file.

    Raises:
        NotAMapError: the file does not exist or is not a map.
        FormatVersionError: a newer Engram wrote it.
        RevisionError: the map has no such revision.
    """
    path = map_path(location)
    lost, notes = _log_facts(path)
    try:
        database = SqliteDatabase(path)
    except MapCorruptError as error:
        return CheckReport((*lost, Problem("file", "", str(error))), 0, 0, (), 0, notes)
    with closing(database):
        found = check(database, thin=thin, since=_number(database, since))
    return replace(found, problems=(*lost, *found.problems), notes=notes)


def _number(database: SqliteDatabase, named: int | str | None) -> int | None:
    if named is None:
        return None
    with database.reading() as connection:
        return resolve(connection, named, database.name)


def _log_facts(path: Path) -> tuple[tuple[Problem, ...], tuple[str, ...]]:
    """Problems and notes about a log that is not being written to."""
    path = path.resolve()
    damage = None if current_holder(path) is not None else log_damage(path)
    if damage is None:
        return (), ()
    return ((Problem("file", "", damage.fact),), ()) if damage.lost else ((), (damage.fact,))
