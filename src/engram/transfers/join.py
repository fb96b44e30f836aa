"""A map put together from its parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from sqlalchemy import Table

from engram.errors import MapCorruptError, MapError
from engram.maps import Map
from engram.maps.exchange import map_of_rows
from engram.maps.schema import frames
from engram.transfers.manifest import Manifest
from engram.transfers.pages import BLOBS, TABLES, PartHash, decode_page

# The part of this hash; None where it is missing.
Source: TypeAlias = Callable[[PartHash], bytes | None]


class MissingPartError(MapError):
    """A part that the map needs is not there."""

    def __init__(self, part: PartHash) -> None:
        super().__init__(f"part {part.hex()[:16]}… is missing")
        self.part = part


def join(manifest: Manifest, source: Source, path: Path, *, thin: bool = False) -> None:
    """Writes the map of a manifest. Whole or not at all.

    Args:
        manifest: what it consists of.
        source: gives the parts, verified against their hashes.
        path: the file, which must not exist.
        thin: whether frames may be missing; their nodes are then without.

    Raises:
        MissingPartError: a part is missing.
        MapCorruptError: parts do not make a map, or not the one of the manifest.
        MapError: it cannot be written.
    """
    with map_of_rows(path) as put:
        for name, table in TABLES.items():
            for page in manifest.pages.get(name, ()):
                put(table, _whole_rows(table, _needed(source, page), source, thin))
    try:
        with Map.open(path, at=None) as store:
            found = store.content_hash()
        if found != manifest.content_hash:
            raise MapCorruptError(
                f"the parts make a map of content {found}, not {manifest.content_hash!r:.40}"
            )
    except BaseException:
        path.unlink()
        raise


def blobs_named(manifest: Manifest, source: Source) -> Iterator[tuple[str, int, list[PartHash]]]:
    """Table and key of each row with blobs, and their hashes.

    Raises:
        MissingPartError: a page is missing.
        MapCorruptError: a page does not hold rows of its table.
    """
    for table, columns in BLOBS.items():
        places = [table.columns.keys().index(name) for name in columns]
        for page in manifest.pages.get(table.name, ()):
            for row in decode_page(table, _needed(source, page)):
                yield table.name, row[0], [row[at] for at in places if row[at] is not None]


def _whole_rows(table: Table, page: bytes, source: Source, thin: bool) -> Iterator[Sequence[Any]]:
    """The rows of a page with their blobs."""
    places = [table.columns.keys().index(name) for name in BLOBS.get(table, ())]
    for slim in decode_page(table, page):
        row = list(slim)
        try:
            for at in places:
                if row[at] is not None:
                    row[at] = _needed(source, PartHash(row[at]))
        except MissingPartError:
            if thin and table is frames:
                continue
            raise
        yield row


def _needed(source: Source, part: PartHash) -> bytes:
    found = source(part)
    if found is None:
        raise MissingPartError(part)
    return found
