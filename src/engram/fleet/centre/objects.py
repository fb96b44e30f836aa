"""Objects: whole files under names, in a folder or in a bucket; and parts in packs."""

from __future__ import annotations

import os
import secrets
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

from sqlalchemy import Connection, delete, select

from engram.errors import MapError, extra, storage_full
from engram.fleet.centre.database import ServiceDatabase, rows_of
from engram.fleet.centre.problems import StoreError
from engram.fleet.centre.tables import GivenPart, Pack, PackedPart, given, packs, parts
from engram.fleet.transfers import PartHash, Split, part_hash
from engram.monitor import write_whole


class Objects(Protocol):
    """Immutable objects by key. A key is written once, or again with the same content."""

    def put(self, key: str, body: bytes) -> None:
        """Stores an object, durable when it returns.

        Raises:
            StorageFullError: no space is left.
            StoreError: it cannot be stored now.
        """
        ...

    def put_file(self, key: str, path: Path) -> None:
        """Stores a file."""
        ...

    def get(self, key: str, start: int = 0, size: int | None = None) -> bytes:
        """An object, or `size` bytes of it.

        Raises:
            MapError: there is none, or it is shorter.
        """
        ...

    def size(self, key: str) -> int:
        """Bytes of an object."""
        ...

    def delete(self, key: str) -> None:
        """Removes an object; a missing one is no error."""
        ...

    def keys(self, prefix: str) -> Iterator[str]:
        """All keys that begin with a prefix and ``/``."""
        ...


class FolderObjects:
    """Objects as files of a folder. Every one is synced with its folder before `put` returns."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def put(self, key: str, body: bytes) -> None:
        """See `Objects`."""
        with self._storing(key) as draft:
            draft.write_bytes(body)

    def put_file(self, key: str, path: Path) -> None:
        """See `Objects`."""
        with self._storing(key) as draft, path.open("rb") as source, draft.open("wb") as copy:
            while piece := source.read(2**20):
                copy.write(piece)

    @contextmanager
    def _storing(self, key: str) -> Iterator[Path]:
        path = self._path(key)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with write_whole(path) as draft:
                yield draft
            sync_folder(path.parent)
        except OSError as error:
            full = storage_full(error, f"object {key}")
            raise full or StoreError(f"object {key} cannot be kept: {error.strerror}") from error

    def get(self, key: str, start: int = 0, size: int | None = None) -> bytes:
        """See `Objects`."""
        try:
            with self._path(key).open("rb") as file:
                file.seek(start)
                body = file.read() if size is None else file.read(size)
        except FileNotFoundError as error:
            raise MapError(f"object {key} is missing") from error
        if size is not None and len(body) != size:
            raise MapError(f"object {key} is shorter than {start + size} bytes")
        return body

    def size(self, key: str) -> int:
        """See `Objects`."""
        try:
            return self._path(key).stat().st_size
        except FileNotFoundError as error:
            raise MapError(f"object {key} is missing") from error

    def delete(self, key: str) -> None:
        """See `Objects`."""
        self._path(key).unlink(missing_ok=True)

    def keys(self, prefix: str) -> Iterator[str]:
        """See `Objects`."""
        for path in sorted((self._folder / prefix).rglob("*")):
            if path.is_file() and not path.name.startswith("."):
                yield path.relative_to(self._folder).as_posix()

    def _path(self, key: str) -> Path:
        return self._folder / key


class BucketObjects:
    """Objects in a bucket that speaks S3, or wherever else obstore reaches."""

    def __init__(self, url: str) -> None:
        with extra("centre", "objects in a bucket need obstore"):
            from obstore.store import from_url
        self._store = from_url(url)

    @contextmanager
    def _errors(self, key: str) -> Iterator[None]:
        from obstore.exceptions import BaseError

        try:
            yield
        except FileNotFoundError as error:
            raise MapError(f"object {key} is missing") from error
        except BaseError as error:
            raise StoreError(f"object {key}: the bucket does not answer well: {error}") from error

    def put(self, key: str, body: bytes) -> None:
        """See `Objects`."""
        with self._errors(key):
            self._store.put(key, body)

    def put_file(self, key: str, path: Path) -> None:
        """See `Objects`."""
        with self._errors(key):
            self._store.put(key, path)

    def get(self, key: str, start: int = 0, size: int | None = None) -> bytes:
        """See `Objects`."""
        with self._errors(key):
            if size is None:
                return bytes(self._store.get(key).bytes())[start:]
            return bytes(self._store.get_range(key, start=start, length=size)) if size else b""

    def size(self, key: str) -> int:
        """See `Objects`."""
        with self._errors(key):
            return int(self._store.head(key)["size"])

    def delete(self, key: str) -> None:
        """See `Objects`."""
        with self._errors(key):
            self._store.delete(key)

    def keys(self, prefix: str) -> Iterator[str]:
        """See `Objects`."""
        with self._errors(prefix):
            for batch in self._store.list(prefix):
                for listed in batch:
                    yield str(listed["path"])


def sync_folder(folder: Path) -> None:
    """Makes names in a folder durable."""
    file = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


# Of one pack: what a broken link costs at most beyond the last whole pack, and one sync each.
PACK_BYTES = 2**20
_BATCH = 500
_CACHED_PACKS = 16


class Packs:
    """The parts of one map.

    Args:
        database, objects: the centre's.
        name: of the map.
    """

    def __init__(self, database: ServiceDatabase, objects: Objects, name: str) -> None:
        self._database = database
        self._objects = objects
        self._map = name
        self._recent: OrderedDict[str, bytes] = OrderedDict()

    def add(self, parts: Iterable[bytes], now_ns: int, robot: str | None = None) -> int:
        """Stores parts that are missing, and notes who gave them.

        Args:
            parts: the parts.
            now_ns: the time.
            robot: who handed them in; None for the centre itself.

        Returns:
            Bytes of the parts that this robot had not given.
        """
        bodies = {part_hash(body): body for body in parts}
        while True:
            new = {part: bodies[part] for part in self.missing(bodies)}
            pack = _new_pack_id(now_ns)
            if new:
                self._objects.put(f"packs/{self._map}/{pack}", b"".join(new.values()))
            with self._database.writing() as connection:
                if new:
                    self._note_pack(connection, pack, new, now_ns)
                if len(self._places(connection, bodies)) < len(bodies):
                    continue  # the rest was swept after it was looked for
                return self._note_given(connection, bodies, robot)

    def add_split(self, taken: Split, clock: Callable[[], int]) -> None:
        """Stores the parts of a map that are missing, a pack at a time."""
        batch, size = list[bytes](), 0
        for body in taken.parts(self.missing([*taken.pages, *taken.blobs])):
            batch.append(body)
            size += len(body)
            if size >= PACK_BYTES:
                self.add(batch, clock())
                batch, size = [], 0
        self.add(batch, clock())

    def _note_given(
        self, connection: Connection, bodies: dict[PartHash, bytes], robot: str | None
    ) -> int:
        if robot is None:
            return sum(map(len, bodies.values()))
        had = given_by(connection, self._map, robot, bodies)
        fresh = [part for part in bodies if part not in had]
        self._database.add_all(connection, [GivenPart(self._map, robot, part) for part in fresh])
        return sum(len(bodies[part]) for part in fresh)

    def missing(self, wanted: Collection[PartHash]) -> list[PartHash]:
        """Those parts that are not stored."""
        with self._database.reading() as connection:
            return self.missing_in(connection, wanted)

    def missing_in(self, connection: Connection, wanted: Collection[PartHash]) -> list[PartHash]:
        """Those parts that are not stored, as a transaction sees it."""
        stored = self._places(connection, wanted)
        return [part for part in wanted if part not in stored]

    def read(self, wanted: Iterable[PartHash]) -> Iterator[tuple[PartHash, bytes]]:
        """The requested parts that are stored, in the order of the request."""
        for batch in _batches(wanted):
            with self._database.reading() as connection:
                places = self._places(connection, batch)
            for part in batch:
                if part in places:
                    yield part, self._body(places[part])

    def _body(self, place: PackedPart) -> bytes:
        try:
            pack = self._pack(place.pack)
        except MapError:  # a sweep has moved or forgotten it since
            with self._database.reading() as connection:
                moved = self._places(connection, [place.hash]).get(place.hash, place)
            if moved.pack == place.pack:
                raise
            place, pack = moved, self._pack(moved.pack)
        return pack[place.start : place.start + place.size]

    def little_needed(
        self, connection: Connection, needed: Collection[PartHash], limit_ns: int
    ) -> list[tuple[str, list[PartHash]]]:
        """Packs written before a time of which less than half is needed, each with that."""
        old = (packs.c.map == self._map, packs.c.written_ns <= limit_ns)
        sizes = {row.id: row.size for row in rows_of(connection, Pack, *old)}
        kept: dict[str, list[PartHash]] = {pack: [] for pack in sizes}
        used = dict.fromkeys(sizes, 0)
        query = select(parts.c.pack, parts.c.hash, parts.c.size).where(parts.c.map == self._map)
        for pack, part, size in connection.execute(query.order_by(parts.c.pack, parts.c.start)):
            if pack in sizes and part in needed:
                kept[pack].append(part)
                used[pack] += size
        return [(pack, needed) for pack, needed in kept.items() if 2 * used[pack] < sizes[pack]]

    def forget(self, connection: Connection, pack: str, kept: list[PartHash], now_ns: int) -> int:
        """Forgets a pack and who gave its parts, except those kept, which move to a new one.

        The object stays. Returns the bytes that are forgotten.
        """
        bodies, moved = dict(self.read(kept)), _new_pack_id(now_ns)
        if bodies:
            self._objects.put(f"packs/{self._map}/{moved}", b"".join(bodies.values()))
        of_pack = (parts.c.map == self._map) & (parts.c.pack == pack)
        rest = set(connection.execute(select(parts.c.hash).where(of_pack)).scalars()) - set(kept)
        for batch in _batches(rest):
            of_batch = (given.c.map == self._map) & given.c.hash.in_(batch)
            connection.execute(delete(given).where(of_batch))
        this = (packs.c.map == self._map) & (packs.c.id == pack)
        size: int = connection.execute(select(packs.c.size).where(this)).scalar_one()
        connection.execute(delete(parts).where(of_pack))
        connection.execute(delete(packs).where(this))
        if bodies:
            self._note_pack(connection, moved, bodies, now_ns)
        return size - sum(map(len, bodies.values()))

    def _note_pack(
        self, connection: Connection, pack: str, bodies: dict[PartHash, bytes], now_ns: int
    ) -> None:
        places, start = [], 0
        for part, body in bodies.items():
            places.append(PackedPart(self._map, part, pack, start, len(body)))
            start += len(body)
        self._database.add(connection, Pack(pack, self._map, start, now_ns))
        self._database.add_all(connection, places)

    def _pack(self, pack: str) -> bytes:
        body = self._recent.pop(pack, None)
        if body is None:
            body = self._objects.get(f"packs/{self._map}/{pack}")
            while len(self._recent) >= _CACHED_PACKS:
                self._recent.popitem(last=False)
        self._recent[pack] = body
        return body

    def _places(self, connection: Connection, wanted: Iterable[bytes]) -> dict[bytes, PackedPart]:
        """Where those parts are that are stored."""
        places = {}
        for batch in _batches(wanted):
            of_batch = (parts.c.map == self._map, parts.c.hash.in_(batch))
            places.update({row.hash: row for row in rows_of(connection, PackedPart, *of_batch)})
        return places


def _new_pack_id(now_ns: int) -> str:
    """A name that no pack ever had: one that is swept does not come back."""
    return f"{now_ns:016x}-{secrets.token_hex(16)}"


def written_ns(pack: str) -> int:
    """When a pack was written, UTC; 0 where the name is not one of a pack."""
    stamp, dash, _ = pack.partition("-")
    return int(stamp, 16) if dash else 0


def _batches(wanted: Iterable[Any]) -> Iterator[list[Any]]:
    """As many at a time as one statement takes."""
    rest = iter(wanted)
    while batch := list(islice(rest, _BATCH)):
        yield batch


def given_by(
    connection: Connection, name: str, robot: str, wanted: Collection[PartHash]
) -> set[bytes]:
    """Those of the parts that a robot has handed in to a map itself."""
    found: set[bytes] = set()
    for batch in _batches(wanted):
        query = select(given.c.hash).where(
            given.c.map == name, given.c.robot == robot, given.c.hash.in_(batch)
        )
        found |= set(connection.execute(query).scalars())
    return found
