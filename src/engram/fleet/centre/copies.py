"""Copies of a map that workers without a shared folder keep, each in its own.

What counts is what was published last: a row of the database, whose manifest and parts lie among
the objects. A revision that a worker committed and did not publish never was: the next who has the
map's lane in that folder goes back to what is published.
"""

from __future__ import annotations

import logging
import secrets
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from sqlalchemy import Connection

from engram.errors import InputError, MapCorruptError
from engram.files import taking_turns
from engram.fleet.catching_up import catch_up
from engram.fleet.centre.database import ServiceDatabase, first_row
from engram.fleet.centre.objects import Objects, Packs, written_ns
from engram.fleet.centre.problems import StoreError
from engram.fleet.centre.tables import Published, published
from engram.fleet.transfers import (
    Manifest,
    PartHash,
    decode_manifest,
    encode_manifest,
    full_pages,
    split,
)
from engram.maps.exchange import stamp_of
from engram.maps.map import Map


def keeps_copies(database: str) -> bool:
    """Whether workers of the centre with this database may begin in a new folder.

    Raises:
        InputError, StoreError: it is no address, or does not answer.
    """
    with closing(ServiceDatabase(database)) as tables:
        return bool(tables.rows(Published, limit=1))


_log = logging.getLogger(__name__)


class Stores(Protocol):
    """What copies are brought up to date from: of a centre."""

    folder: Path
    database: ServiceDatabase
    objects: Objects
    now_ns: Callable[[], int]

    def packs(self, name: str) -> Packs:
        """The parts of a map."""
        ...


@dataclass(frozen=True, slots=True)
class Publication:
    """A revision whose parts and manifest are stored; it counts once its row does.

    Attributes:
        row: what is to be the map's row.
        before: id of the publication that it continues; None for whatever there is.
        added: the parts that the one before does not need.
    """

    row: Published
    before: str | None
    added: tuple[PartHash, ...]


class Copies:
    """The copies in one folder.

    Args:
        stores: the centre's.
    """

    def __init__(self, stores: Stores) -> None:
        self._stores = stores
        # Stamp of what is published and was found in the file, by map.
        self._found: dict[str, str] = {}

    def row(self, name: str) -> Published:
        """What is published of a map.

        Raises:
            StoreError: nothing is.
        """
        row = self._stores.database.row(Published, published.c.map == name)
        if row is None:
            raise StoreError(f"nothing of {name} is published; engram centre map --copies does")
        return row

    def bring(self, name: str) -> Published:
        """Brings the file to what is published, unless it holds that, perhaps with more.

        Raises:
            StoreError, MapError: it cannot be fetched or written now.
        """
        row, path = self.row(name), self._path(name)
        if self._found.get(name) == row.stamp and path.exists():
            return row
        if not path.exists() or stamp_of(path, row.revision)[1] != row.stamp:
            row = self.renew(name)
        self._found[name] = row.stamp
        return row

    def renew(self, name: str) -> Published:
        """Makes the file what is published, without what was committed after it.

        Only in the map's lane, or where what is published is missing in the file: a worker that has
        the lane in this folder has brought that, and no other can publish.

        Raises:
            MapLockedError: another process writes to the file.
            StoreError, MapError: it cannot be fetched or written now.
        """
        path = self._path(name)
        with taking_turns(path.with_name(f"{name}.copy-lock")):
            row = self.row(name)
            if not path.exists():
                Map.create(path).close()
            head, stamp = stamp_of(path)
            if (head, stamp) != (row.revision, row.stamp):
                if head > row.revision:
                    _log.warning(
                        "%s: revision %d here was not published; back to revision %d",
                        name, head, row.revision,
                    )  # fmt: skip
                catch_up(path, self._manifest(row), self._stores.packs(name).read)
                if stamp_of(path) != (row.revision, row.stamp):
                    raise MapCorruptError(f"{path} is not what was published of {name}")
        return row

    def prepare(self, name: str, *, whole: bool = False) -> Publication | None:
        """Stores what the file has beyond what is published; None if that is nothing.

        Args:
            name: of the map.
            whole: read all of the file, which may not continue what is published.

        Raises:
            StorageFullError, StoreError, MapError: it cannot be stored now.
        """
        path, before = self._path(name), None if whole else self.row(name)
        revision, stamp = stamp_of(path)
        if before is not None and before.stamp == stamp:
            return None
        packs, base, kept = self._stores.packs(name), Manifest("", 0, {}), None
        if before is not None:
            base = self._manifest(before)
            kept = full_pages(base, lambda part: dict(packs.read([part])).get(part))
        taken = split(path, revision, set(base.hashes()), kept)
        packs.add_split(taken, self._stores.now_ns)
        key = f"{self._stores.now_ns():016x}-{secrets.token_hex(16)}"
        self._stores.objects.put(published_key(name, key), encode_manifest(taken.manifest))
        return Publication(
            Published(name, revision, stamp, taken.manifest.content_hash, key),
            None if before is None else before.manifest,
            (*taken.pages, *taken.blobs),
        )

    def publish(self, connection: Connection, found: Publication | None) -> None:
        """Publishes; call it in the transaction that notes what led to it.

        Raises:
            StoreError: another worker has published since, or a sweep took a part.
        """
        if found is None:
            return
        name = found.row.map
        if found.before is not None:
            now = first_row(connection, Published, published.c.map == name)
            if now is None or now.manifest != found.before:
                raise StoreError(f"{name}: another worker published meanwhile; it is done again")
        if self._stores.packs(name).missing_in(connection, found.added):
            raise StoreError(f"{name}: a sweep took parts of what is published; it is done again")
        self._stores.database.put(connection, found.row)

    def continues(self, name: str) -> bool:
        """Whether the file holds something that is not published, after what is.

        Raises:
            InputError: it does, but not after what is.
        """
        row, path = self.row(name), self._path(name)
        if stamp_of(path) == (row.revision, row.stamp):
            return False
        with Map.open(path) as store:
            if store.revision < row.revision:
                return False
            with Map.open(path, at=row.revision) as then:
                if then.content_hash() == row.content_hash:
                    return True
        raise InputError(
            f"{path} does not continue revision {row.revision}, which another worker published: "
            "stop all workers before you write to it, and restore it from a backup"
        )

    def clean(self, name: str, limit_ns: int) -> None:
        """Deletes the manifests of older publications, written before a time."""
        row = self.row(name)
        for key in self._stores.objects.keys(f"published/{name}"):
            number = key.rsplit("/", 1)[1]
            if number != row.manifest and written_ns(number) <= limit_ns:
                self._stores.objects.delete(key)

    def _manifest(self, row: Published) -> Manifest:
        return decode_manifest(self._stores.objects.get(published_key(row.map, row.manifest)))

    def _path(self, name: str) -> Path:
        return self._stores.folder / "maps" / f"{name}.engram"


def published_key(name: str, number: str) -> str:
    """Where the manifest of a publication is kept among the objects."""
    return f"published/{name}/{number}"
