"""Pages: some rows of one table, encoded.

Rows are only ever added to a map, so a page that is full stays as it is: whoever has it once need
not get it again. Pages begin again wherever the rows so far fill one, which depends on these rows
alone. Blobs (landmarks, thumbnails, vocabularies) are parts of their own; pages hold their hashes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import Annotated, Any, NewType

import msgspec
from sqlalchemy import Table

from engram.errors import MapCorruptError
from engram.maps.exchange import EXCHANGED
from engram.maps.schema import frames, vocabularies

# SHA-256 of a part's bytes.
PartHash = NewType("PartHash", bytes)

# Large enough that a manifest stays short, small enough that the last page of each table, which is
# sent again as it fills, costs little.
PAGE_BYTES = 8192
# Of one part: the longest attempts of a session and the vocabulary fit.
MAX_PART_BYTES = 16 * 2**20
# Columns whose values are parts of their own.
BLOBS: dict[Table, tuple[str, ...]] = {frames: ("landmarks", "thumbnail"), vocabularies: ("body",)}
TABLES: dict[str, Table] = {table.name: table for table in EXCHANGED}

_Int64 = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
_encode = msgspec.msgpack.Encoder().encode


def part_hash(body: bytes) -> PartHash:
    """The name of a part."""
    return PartHash(hashlib.sha256(body).digest())


def encode_pages(rows: Iterable[Sequence[Any]]) -> Iterator[bytes]:
    """Pages of the rows of one table, blobs replaced by their hashes."""
    page: list[bytes] = []
    size = 0
    for row in rows:
        page.append(_encode(row))
        size += len(page[-1])
        if size >= PAGE_BYTES:
            yield _joined(page)
            page, size = [], 0
    if page:
        yield _joined(page)


def _joined(rows: list[bytes]) -> bytes:
    """A MessagePack array of encoded rows."""
    head = bytes([0xDD]) + len(rows).to_bytes(4, "big")
    return head + b"".join(rows)


def decode_page(table: Table, body: bytes) -> list[tuple[Any, ...]]:
    """The rows of a page.

    Raises:
        MapCorruptError: it does not hold rows of this table.
    """
    try:
        rows: list[tuple[Any, ...]] = _decoder(table).decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise MapCorruptError(f"a page does not hold rows of {table.name}: {error}") from error
    return rows


@cache
def _decoder(table: Table) -> msgspec.msgpack.Decoder[Any]:
    """Decodes arrays of exactly this table's columns and types, of any length and no depth."""
    kinds = []
    for column in table.columns:
        kind: Any = _Int64 if column.type.python_type is int else column.type.python_type
        kinds.append(kind | None if column.nullable else kind)
    return msgspec.msgpack.Decoder(list[tuple[tuple(kinds)]])  # type: ignore[misc]
