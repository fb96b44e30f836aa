"""Blocks of places that a map stores for a place recogniser: a lost robot reads them one by one.

A place is a node; block b holds the nodes with keys b · P + 1 to b · P + P. Blocks follow from
other rows and belong to no revision. A missing or damaged one costs time, or the places in it.
"""

from __future__ import annotations

import logging
from collections import OrderedDict
from threading import Lock
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, bindparam, delete, select

from engram import _core
from engram.errors import MapCorruptError
from engram.maps.rows import Row, sealed, verified
from engram.maps.schema import place_blocks
from engram.maps.sqlite import SqliteDatabase, upsert

# Nodes of a block.
PLACES_PER_BLOCK = _core.PLACES_PER_BLOCK
NUMBERS, UNREADABLE, BODY = "numbers", "unreadable", "body"
Parts: TypeAlias = dict[str, bytes]
PARTS = (NUMBERS, UNREADABLE, BODY)
# What stays in memory of the bodies; 1,000,000 places of FAB-MAP take 380 MB.
_MOST_BYTES = 64 * 2**20

_log = logging.getLogger(__name__)

_OF_RECOGNISER = (place_blocks.c.vocabulary == bindparam("vocabulary")) & (
    place_blocks.c.recogniser == bindparam("recogniser")
)
_PART = select(*place_blocks.columns).where(
    _OF_RECOGNISER,
    place_blocks.c.block == bindparam("number"),
    place_blocks.c.part == bindparam("part"),
)
_BODIES = (
    select(place_blocks.c.block)
    .where(_OF_RECOGNISER, place_blocks.c.part == BODY)
    .order_by(place_blocks.c.block)
)


class StoredBlocks:
    """The blocks of one recogniser in a map; any thread may read them.

    Args:
        database: the map's database.
        vocabulary: hash (16 bytes) of the vocabulary.
        recogniser: `StoresBlocks.stored_as`.
    """

    def __init__(self, database: SqliteDatabase, vocabulary: bytes, recogniser: str) -> None:
        self._database = database
        self._of = {"vocabulary": vocabulary, "recogniser": recogniser}
        self._bodies: OrderedDict[int, bytes | None] = OrderedDict()
        self._bytes = 0
        self._lock = Lock()

    def read(self, rows: int) -> tuple[NDArray[np.float64], set[int]]:
        """What stays in memory of all blocks from the first on, up to one that is missing.

        Args:
            rows: `StoresBlocks.rows_of_numbers`.

        Returns:
            Numbers (rows, P) float64, log-likelihoods, P a multiple of `PLACES_PER_BLOCK`; and the
            places without readable landmarks.
        """
        numbers, unreadable = [np.zeros((rows, 0))], set[int]()
        for number in range(self.count):
            found = [self._part(number, part) for part in (NUMBERS, UNREADABLE)]
            if not self._fit(found, rows):
                break
            of_places, of_unreadable = (part for part in found if part is not None)
            numbers.append(np.frombuffer(of_places, "<f8").reshape(rows, -1))
            places = np.frombuffer(of_unreadable, "<i4") + number * PLACES_PER_BLOCK
            unreadable.update(places.tolist())
        return np.concatenate(numbers, axis=1).astype(np.float64), unreadable

    @property
    def count(self) -> int:
        """Number of blocks from the first on, up to one that is missing."""
        with self._database.reading() as connection:
            stored = connection.execute(_BODIES, self._of).scalars().all()
        return next((at for at, number in enumerate(stored) if at != number), len(stored))

    def body(self, number: int) -> bytes | None:
        """What a query reads of a block; None where it is damaged."""
        with self._lock:
            if number in self._bodies:
                self._bodies.move_to_end(number)
                return self._bodies[number]
        found = self._part(number, BODY)
        with self._lock:
            if number not in self._bodies:
                self._bytes += len(found or b"")
            self._bodies[number] = found
            while self._bytes > _MOST_BYTES:
                self._bytes -= len(self._bodies.popitem(last=False)[1] or b"")
        return found

    def _part(self, number: int, part: str) -> bytes | None:
        row = self._database.first(_PART, {**self._of, "number": number, "part": part})
        if row is None:
            return None
        try:
            content = next(verified(place_blocks, [row]))["content"]
        except (MapCorruptError, ValueError) as error:
            _log.warning("%s; its places are not proposed", error)
            return None
        return bytes(content)

    @staticmethod
    def _fit(found: list[bytes | None], rows: int) -> bool:
        numbers, unreadable = found
        return (
            numbers is not None
            and len(numbers) == 8 * rows * PLACES_PER_BLOCK
            and unreadable is not None
            and not problem_of(UNREADABLE, unreadable)
        )


def problem_of(part: str, content: bytes) -> str:
    """The fault of a part of a block; "" if it has none."""
    if part not in PARTS:
        return f"has the part {part!r}, must be one of {', '.join(PARTS)}"
    if part == NUMBERS and len(content) % (8 * PLACES_PER_BLOCK):
        return (
            f"its numbers have {len(content)} bytes, of which {PLACES_PER_BLOCK} places need more"
        )
    if part == UNREADABLE:
        if len(content) % 4:
            return f"{len(content)} bytes are no places"
        places = np.frombuffer(content, "<i4")
        if ((places < 0) | (places >= PLACES_PER_BLOCK)).any() or (np.diff(places) <= 0).any():
            return "its unreadable places do not rise within the block"
    return ""


def block_parts(numbers: NDArray[np.float64], body: bytes, unreadable: list[int]) -> Parts:
    """The content of a block by part.

    Args:
        numbers: (rows, P) float64, log-likelihoods, of the `PlaceBlock`.
        body: of it.
        unreadable: numbers within the block of places without readable landmarks, rising.
    """
    return {
        NUMBERS: numbers.astype("<f8").tobytes(),
        UNREADABLE: np.array(unreadable, "<i4").tobytes(),
        BODY: body,
    }


def block_rows(vocabulary: bytes, recogniser: str, number: int, parts: Parts) -> list[Row]:
    """The rows of a block."""
    of_block = {"block": number, "vocabulary": vocabulary, "recogniser": recogniser}
    return [
        sealed(place_blocks, {**of_block, "part": part, "content": parts[part]}) for part in PARTS
    ]


def write_block(connection: Connection, rows: list[Row]) -> None:
    """Stores a block, replacing that of the same number, and those by another vocabulary."""
    others = place_blocks.c.vocabulary != rows[0]["vocabulary"]
    connection.execute(delete(place_blocks).where(others))
    names = ("vocabulary", "recogniser", "block", "part")
    connection.execute(upsert(place_blocks, names), rows)
