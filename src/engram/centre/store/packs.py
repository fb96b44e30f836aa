"""Parts in packs: one object holds many, since small objects crawl."""

from __future__ import annotations

import hashlib
import secrets
from collections import OrderedDict
from collections.abc import Collection, Iterable, Iterator
from typing import Any

from sqlalchemy import Connection, Select, delete, select

from engram.centre.store.database import ServiceDatabase, rows_of
from engram.centre.store.objects import Objects
from engram.centre.store.schema import given, packs, parts
from engram.errors import MapError
from engram.transfers import PartHash

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
