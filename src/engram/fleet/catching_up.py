"""A map file that is made to hold what a manifest lists, at the cost of what is missing in it.

What it shares with the manifest is found by the rows of its revisions. Whatever came after them
goes, committed or not; the rest of the manifest is added, all in one transaction.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

from sqlalchemy import Table

from engram.errors import MapCorruptError, MapError
from engram.fleet.transfers import (
    ONLY_ADDED,
    TABLES,
    Manifest,
    MissingPartError,
    PartHash,
    blobs_of,
    decode_page,
    encode_pages,
    part_hash,
    slim_row,
    whole_rows,
)
from engram.maps.exchange import Rewriting, Values, rewriting
from engram.maps.schema import receipts, revisions

_log = logging.getLogger(__name__)
# Gives the wanted parts that there are.
ReadParts: TypeAlias = Callable[[Iterable[PartHash]], Iterator[tuple[PartHash, bytes]]]
_PAGES_AT_ONCE = 64
_FIRST_KEY = -(2**63)
_NUMBER = revisions.columns.keys().index("number")


def catch_up(path: Path, manifest: Manifest, read: ReadParts) -> None:
    """Makes an existing map file hold what a manifest lists, to the bit of every row.

    Args:
        path: the map file; readers continue at revisions that stay.
        manifest: what it is to hold.
        read: gives the parts.

    Raises:
        MissingPartError: a part is missing.
        MapCorruptError: the parts do not make the map of the manifest.
        MapLockedError: another process writes to the file.
        MapError: it cannot be read or written.
    """
    try:
        _CatchingUp(path, manifest, read).run()
    except MapError as error:
        if type(error) not in {MapError, MapCorruptError}:  # no room, a lock, a missing part
            raise
        _log.warning("%s: %s; all of it is written again", path.name, error)
        _CatchingUp(path, manifest, read).run(whole=True)


class _CatchingUp:
    def __init__(self, path: Path, manifest: Manifest, read: ReadParts) -> None:
        self._path = path
        self._manifest = manifest
        self._read = read

    def run(self, *, whole: bool = False) -> None:
        """Writes the file, all of it where nothing can be shared."""
        with rewriting(self._path) as copy:
            common, new = (0, set[int]()) if whole else self._shared(copy)
            if common:
                copy.go_back(common)
            else:
                copy.clear()
            for table in TABLES.values():
                if table in ONLY_ADDED:
                    self._add_new(copy, table, new if common else None)
                else:
                    self._replace_end(copy, table)
            self._check(copy, common)

    def _check(self, copy: Rewriting, common: int) -> None:
        found = copy.verified_hash(self._manifest.revision, common)
        if found != self._manifest.content_hash:
            raise MapCorruptError(
                f"the parts make a map of content {found}, not {self._manifest.content_hash}"
            )

    def _shared(self, copy: Rewriting) -> tuple[int, set[int]]:
        """The newest revision that both have, and the keys of those after it."""
        erased = encode_pages(copy.of(receipts, self._manifest.revision))
        if tuple(map(part_hash, erased)) != self._pages(receipts):
            return 0, set()  # rows in the middle are gone
        new: set[int] = set()
        for page in reversed(self._pages(revisions)):
            for row in reversed(self._rows(revisions, page)):
                if copy.has(row):
                    return row[_NUMBER], new
                new.add(row[0])
        return 0, new

    def _add_new(self, copy: Rewriting, table: Table, new: Collection[int] | None) -> None:
        """Adds the rows of new revisions; all rows where None is given."""
        at = 0 if table is revisions else table.columns.keys().index("revision")

        def is_new(row: Values) -> bool:
            return new is None or row[at] in new

        pages = self._pages(table)
        first = 0 if new is None else self._first_with(table, pages, is_new)
        self._put(copy, table, pages[first:], is_new)

    def _first_with(
        self, table: Table, pages: Sequence[PartHash], is_new: Callable[[Values], bool]
    ) -> int:
        """The first page with new rows, which come after the others."""
        for first in range(len(pages), 0, -1):
            if not any(map(is_new, self._rows(table, pages[first - 1]))):
                return first
        return 0

    def _replace_end(self, copy: Rewriting, table: Table) -> None:
        """Replaces the rows from the first page on that differs."""
        theirs, kept, since = self._pages(table), 0, _FIRST_KEY
        ours = list(self._own_pages(copy, table, since))
        for our, their in zip(ours, theirs, strict=False):
            if part_hash(our) != their:
                break
            kept, since = kept + 1, decode_page(table, our)[-1][0] + 1
        if kept < max(len(ours), len(theirs)):
            copy.cut(table, since)
            self._put(copy, table, theirs[kept:], lambda _: True)

    def _put(
        self,
        copy: Rewriting,
        table: Table,
        pages: Sequence[PartHash],
        is_new: Callable[[Values], bool],
    ) -> None:
        """Puts the new rows of the last pages, and compares those pages with the result."""
        since = None
        for at in range(0, len(pages), _PAGES_AT_ONCE):
            some = pages[at : at + _PAGES_AT_ONCE]
            bodies = self._parts(some)
            for page in some:
                rows = decode_page(table, bodies[page])
                since = rows[0][0] if since is None else since
                fresh = list(filter(is_new, rows))
                blobs = self._parts(chain.from_iterable(blobs_of(table, row) for row in fresh))
                copy.put(table, whole_rows(table, fresh, blobs.get))
        if since is None:
            return
        if tuple(map(part_hash, self._own_pages(copy, table, since))) != tuple(pages):
            raise MapCorruptError(
                f"the rows of {table.name} do not continue as those of the manifest"
            )

    def _own_pages(self, copy: Rewriting, table: Table, since: int) -> Iterator[bytes]:
        rows = copy.of(table, self._manifest.revision, since)
        return encode_pages(slim_row(table, row) for row in rows)

    def _pages(self, table: Table) -> tuple[PartHash, ...]:
        return self._manifest.pages.get(table.name, ())

    def _rows(self, table: Table, page: PartHash) -> list[tuple[Any, ...]]:
        return decode_page(table, self._parts([page])[page])

    def _parts(self, wanted: Iterable[PartHash]) -> dict[PartHash, bytes]:
        """The wanted parts.

        Raises:
            MissingPartError: one is missing.
        """
        parts = list(dict.fromkeys(wanted))
        found = dict(self._read(parts))
        for part in parts:
            if part not in found:
                raise MissingPartError(part)
        return found
