"""Objects: whole files under names, in a folder or in a bucket; and parts in packs."""

from __future__ import annotations

import hashlib
import os
import secrets
from collections import OrderedDict
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from sqlalchemy import Connection, Select, delete, select

from engram.errors import MapError, MissingExtraError, storage_full
from engram.fleet.centre.database import ServiceDatabase, given, packs, parts, rows_of
from engram.fleet.centre.errors import StoreError
from engram.fleet.transfers import PartHash
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
        try:
            from obstore.store import from_url
        except ImportError as error:
            raise MissingExtraError(
                "objects in a bucket need obstore: pip install 'engram-localisation[centre]'"
            ) from error
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
            for some in self._store.list(prefix):
                for one in some:
                    yield str(one["path"])


def sync_folder(folder: Path) -> None:
    """Makes names in a folder durable."""
    file = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


# Of one pack: what a broken link costs at most beyond the last whole pack, and one sync each.
PACK_BYTES = 2**20
_ASKED_AT_ONCE = 500
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

    def add(self, some: Iterable[bytes], now_ns: int, robot: str | None = None) -> int:
        """Stores parts that are not there yet, and notes who gave them.

        Args:
            some: parts.
            now_ns: the time.
            robot: who handed them in; None for the centre itself.

        Returns:
            Bytes of the parts that this robot had not given.
        """
        bodies = {PartHash(hashlib.sha256(one).digest()): one for one in some}
        while True:
            new = {one: bodies[one] for one in self.lacking(bodies)}
            pack = self._put(b"".join(new.values()), now_ns) if new else ""
            with self._database.writing() as connection:
                if new:
                    self._note_pack(connection, pack, new, now_ns)
                if len(self._known(connection, bodies)) < len(bodies):
                    continue  # the rest was swept after it was looked for
                return self._note_given(connection, bodies, robot)

    def _put(self, body: bytes, now_ns: int) -> str:
        """Stores a pack under a name that none ever had: one that is swept does not come back."""
        pack = f"{now_ns:016x}-{secrets.token_hex(16)}"
        self._objects.put(f"packs/{self._map}/{pack}", body)
        return pack

    def _note_given(
        self, connection: Connection, bodies: dict[PartHash, bytes], robot: str | None
    ) -> int:
        if robot is None:
            return sum(map(len, bodies.values()))
        had = given_by(connection, self._map, robot, bodies)
        fresh = [one for one in bodies if one not in had]
        rows = [{"map": self._map, "robot": robot, "hash": one} for one in fresh]
        self._database.add(connection, given, rows)
        return sum(len(bodies[one]) for one in fresh)

    def _placed(self, new: dict[PartHash, bytes], pack: str) -> Iterator[dict[str, object]]:
        start = 0
        for one, body in new.items():
            yield {
                "map": self._map,
                "hash": one,
                "pack": pack,
                "start": start,
                "size": len(body),
            }
            start += len(body)

    def lacking(self, some: Collection[PartHash]) -> list[PartHash]:
        """Those that are not there."""
        with self._database.reading() as connection:
            known = self._known(connection, some)
        return [one for one in some if one not in known]

    def read(self, wanted: Iterable[PartHash]) -> Iterator[tuple[PartHash, bytes]]:
        """The requested parts that are there, in the order of the request."""
        batch: list[PartHash] = []
        for one in wanted:
            batch.append(one)
            if len(batch) == _ASKED_AT_ONCE:
                yield from self._read(batch)
                batch = []
        yield from self._read(batch)

    def _read(self, wanted: list[PartHash]) -> Iterator[tuple[PartHash, bytes]]:
        places = self._places(wanted)
        for one in wanted:
            if one not in places:
                continue
            row = places[one]
            try:
                pack = self._pack(row["pack"])
            except MapError:  # a sweep has moved or forgotten it since
                moved = self._places([one]).get(one, row)
                if moved["pack"] == row["pack"]:
                    raise
                row, pack = moved, self._pack(moved["pack"])
            yield one, pack[row["start"] : row["start"] + row["size"]]

    def _places(self, wanted: list[PartHash]) -> dict[PartHash, dict[str, Any]]:
        with self._database.reading() as connection:
            rows = rows_of(connection, self._query(wanted))
        return {row["hash"]: row for row in rows}

    def little_needed(
        self, connection: Connection, needed: Collection[PartHash], limit_ns: int
    ) -> list[tuple[str, list[PartHash]]]:
        """Packs written before a time of which less than half is needed, each with that."""
        old = select(packs).where(packs.c.map == self._map, packs.c.written_ns <= limit_ns)
        sizes = {row["id"]: row["size"] for row in rows_of(connection, old)}
        kept: dict[str, list[PartHash]] = {pack: [] for pack in sizes}
        used = dict.fromkeys(sizes, 0)
        query = select(parts.c.pack, parts.c.hash, parts.c.size).where(parts.c.map == self._map)
        for pack, part, size in connection.execute(query.order_by(parts.c.pack, parts.c.start)):
            if pack in sizes and part in needed:
                kept[pack].append(part)
                used[pack] += size
        return [(pack, some) for pack, some in kept.items() if 2 * used[pack] < sizes[pack]]

    def forget(self, connection: Connection, pack: str, kept: list[PartHash], now_ns: int) -> int:
        """Forgets a pack and who gave its parts, but for some, which move to a new one.

        The object stays. Returns the bytes that are forgotten.
        """
        bodies = dict(self.read(kept))
        moved = self._put(b"".join(bodies.values()), now_ns) if bodies else ""
        of_pack = (parts.c.map == self._map) & (parts.c.pack == pack)
        rest = set(connection.execute(select(parts.c.hash).where(of_pack)).scalars()) - set(kept)
        for some in _in_turns(rest):
            connection.execute(
                delete(given).where(given.c.map == self._map, given.c.hash.in_(some))
            )
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
        size = sum(map(len, bodies.values()))
        row = {"id": pack, "map": self._map, "size": size, "written_ns": now_ns}
        self._database.add(connection, packs, [row])
        self._database.add(connection, parts, list(self._placed(bodies, pack)))

    def _pack(self, pack: str) -> bytes:
        body = self._recent.pop(pack, None)
        if body is None:
            body = self._objects.get(f"packs/{self._map}/{pack}")
            while len(self._recent) >= _CACHED_PACKS:
                self._recent.popitem(last=False)
        self._recent[pack] = body
        return body

    def _known(self, connection: Connection, some: Iterable[PartHash]) -> set[bytes]:
        found = set()
        for asked in _in_turns(some):
            found |= {row["hash"] for row in rows_of(connection, self._query(asked))}
        return found

    def _query(self, some: list[PartHash]) -> Select[Any]:
        return select(parts).where(parts.c.map == self._map, parts.c.hash.in_(some))


def written_ns(pack: str) -> int:
    """When a pack was written, UTC; 0 for one of an older Engram, which its content names."""
    stamp, dash, _ = pack.partition("-")
    return int(stamp, 16) if dash else 0


def _in_turns(some: Iterable[Any]) -> Iterator[list[Any]]:
    """As many at a time as one statement takes."""
    wanted = list(some)
    for at in range(0, len(wanted), _ASKED_AT_ONCE):
        yield wanted[at : at + _ASKED_AT_ONCE]


def given_by(
    connection: Connection, name: str, robot: str, some: Collection[PartHash]
) -> set[bytes]:
    """Those of the parts that a robot has handed in to a map itself."""
    found: set[bytes] = set()
    for asked in _in_turns(some):
        query = select(given.c.hash).where(
            given.c.map == name, given.c.robot == robot, given.c.hash.in_(asked)
        )
        found |= set(connection.execute(query).scalars())
    return found
