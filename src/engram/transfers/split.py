"""A map taken apart."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sqlalchemy import Table

from engram.maps import Map
from engram.maps.exchange import EXCHANGED, MapRows, Values
from engram.transfers.manifest import Manifest
from engram.transfers.pages import BLOBS, PartHash, encode_pages, part_hash


@dataclass(slots=True)
class Split:
    """A map and its parts. Blobs stay in the map and are read when requested.

    Attributes:
        location: the map file.
        manifest: what it consists of.
        pages: new pages by hash.
        blobs: table, key and column of each new blob, by hash.
    """

    location: Path
    manifest: Manifest
    pages: dict[PartHash, bytes] = field(default_factory=dict)
    blobs: dict[PartHash, tuple[Table, int, int]] = field(default_factory=dict)

    def __contains__(self, part: object) -> bool:
        return part in self.pages or part in self.blobs

    def parts(self, wanted: Sequence[PartHash]) -> Iterator[bytes]:
        """The wanted parts that it has, in their order."""
        with closing(MapRows(self.location, self.manifest.revision)) as rows:
            for one in wanted:
                if one in self.pages:
                    yield self.pages[one]
                elif one in self.blobs:
                    table, key, at = self.blobs[one]
                    yield rows.one(table, key)[at]


def split(location: Path, at: int | None = None, known: Collection[PartHash] = ()) -> Split:
    """Takes a map apart.

    Args:
        location: the map file; another process may write to it.
        at: the last revision to hand over; None for the newest.
        known: parts that the other side has, which are left out of `pages` and `blobs`.

    Raises:
        MapError: the map cannot be read or is damaged.
    """
    found = Split(location, Manifest("", 0, {}))
    pages: dict[str, tuple[PartHash, ...]] = {}
    with closing(MapRows(location, at)) as rows:
        for table in EXCHANGED:
            hashes = []
            for page in encode_pages(_slim(found, table, row, known) for row in rows.of(table)):
                name = part_hash(page)
                hashes.append(name)
                if name not in known:
                    found.pages[name] = page
            if hashes:
                pages[table.name] = tuple(hashes)
        revision = rows.revision
    with Map.open(location, at=revision) as store:
        found.manifest = Manifest(store.content_hash(), revision, pages)
    return found


def _slim(found: Split, table: Table, row: Values, known: Collection[PartHash]) -> Sequence[Any]:
    """The row with the hashes of its blobs in their places."""
    if table not in BLOBS:
        return row
    slim = list(row)
    for name in BLOBS[table]:
        at = table.columns.keys().index(name)
        if slim[at] is not None:
            body = slim[at]
            slim[at] = part_hash(body)
            if slim[at] not in known:
                found.blobs[slim[at]] = (table, row[0], at)
    return slim
