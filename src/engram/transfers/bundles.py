"""Bundles: parts one after another in one body, each usable as soon as it has arrived.

A part is its SHA-256 (32 bytes), its size, the size of what follows (4 bytes each, big-endian), and
the part itself, deflated where that is shorter. A body that breaks off loses one part at most.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator

from engram.errors import InputError
from engram.transfers.pages import MAX_PART_BYTES, PartHash, part_hash

_HEAD = struct.Struct(">32sII")


def bundle(parts: Iterable[bytes]) -> Iterator[bytes]:
    """The body, part by part."""
    for body in parts:
        packed = zlib.compress(body)
        sent = packed if len(packed) < len(body) else body
        yield _HEAD.pack(part_hash(body), len(body), len(sent)) + sent


class Unbundler:
    """Takes a body in any pieces, and gives its parts, verified."""

    def __init__(self) -> None:
        self._pending = bytearray()

    def feed(self, piece: bytes) -> Iterator[tuple[PartHash, bytes]]:
        """The parts that are complete with this piece.

        Raises:
            InputError: a part is too large, or is not what its hash says.
        """
        self._pending += piece
        while len(self._pending) >= _HEAD.size:
            named, size, packed = _HEAD.unpack_from(self._pending)
            if size > MAX_PART_BYTES or packed > size:
                raise InputError(f"a part of {size} bytes; at most {MAX_PART_BYTES} are taken")
            if len(self._pending) < _HEAD.size + packed:
                return
            sent = bytes(self._pending[_HEAD.size : _HEAD.size + packed])
            del self._pending[: _HEAD.size + packed]
            yield PartHash(named), _checked(named, _unpacked(sent, size))


def _unpacked(sent: bytes, size: int) -> bytes:
    """The part; never more bytes than announced, so that nothing inflates without bounds."""
    if len(sent) == size:
        return sent
    try:
        body = zlib.decompressobj().decompress(sent, size + 1)
    except zlib.error as error:
        raise InputError(f"a part cannot be inflated: {error}") from error
    if len(body) != size:
        raise InputError(f"a part does not have the {size} bytes that it announces")
    return body


def _checked(named: bytes, body: bytes) -> bytes:
    if part_hash(body) != named:
        raise InputError(f"a part does not match its hash {named.hex()[:16]}…; send it again")
    return body
