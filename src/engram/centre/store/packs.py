"""Parts in packs: one object holds many, since small objects crawl."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Collection, Iterable, Iterator
from typing import Any

from sqlalchemy import Connection, Select, select

from engram.centre.store.database import ServiceDatabase, rows_of
from engram.centre.store.objects import Objects
from engram.centre.store.schema import given, packs, parts
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
        with self._database.reading() as connection:
            known = self._known(connection, bodies)
        new = {one: body for one, body in bodies.items() if one not in known}
        body = b"".join(new.values())
        pack = hashlib.sha256(body).hexdigest()
        if new:
            self._objects.put(f"packs/{self._map}/{pack}", body)
        with self._database.writing() as connection:
            if new:
                row = {"id": pack, "map": self._map, "size": len(body), "written_ns": now_ns}
                self._database.add(connection, packs, [row])
                self._database.add(connection, parts, list(self._placed(new, pack)))
            if robot is None:
                return len(body)
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
        """The wanted parts that are there, in the order in which they are asked for."""
        batch: list[PartHash] = []
        for one in wanted:
            batch.append(one)
            if len(batch) == _ASKED_AT_ONCE:
                yield from self._read(batch)
                batch = []
        yield from self._read(batch)

    def _read(self, wanted: list[PartHash]) -> Iterator[tuple[PartHash, bytes]]:
        with self._database.reading() as connection:
            rows = rows_of(connection, self._query(wanted))
        places = {row["hash"]: row for row in rows}
        for one in wanted:
            row = places.get(one)
            if row is not None:
                pack = self._pack(row["pack"])
                yield one, pack[row["start"] : row["start"] + row["size"]]

    def _pack(self, pack: str) -> bytes:
        body = self._recent.pop(pack, None)
        if body is None:
            body = self._objects.get(f"packs/{self._map}/{pack}")
            while len(self._recent) >= _CACHED_PACKS:
                self._recent.popitem(last=False)
        self._recent[pack] = body
        return body

    def _known(self, connection: Connection, some: Iterable[PartHash]) -> set[bytes]:
        wanted, found = list(some), set()
        for at in range(0, len(wanted), _ASKED_AT_ONCE):
            query = self._query(wanted[at : at + _ASKED_AT_ONCE])
            found |= {row["hash"] for row in rows_of(connection, query)}
        return found

    def _query(self, some: list[PartHash]) -> Select[Any]:
        return select(parts).where(parts.c.map == self._map, parts.c.hash.in_(some))


def given_by(
    connection: Connection, name: str, robot: str, some: Collection[PartHash]
) -> set[bytes]:
    """Those of the parts that a robot has handed in to a map itself."""
    wanted, found = list(some), set()
    for at in range(0, len(wanted), _ASKED_AT_ONCE):
        query = select(given.c.hash).where(
            given.c.map == name,
            given.c.robot == robot,
            given.c.hash.in_(wanted[at : at + _ASKED_AT_ONCE]),
        )
        found |= set(connection.execute(query).scalars())
    return found
