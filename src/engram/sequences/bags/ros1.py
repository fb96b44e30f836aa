"""ROS 1 bags, format 2.0, from front to back.

Source: ROS wiki, "Bags/Format/2.0": records of a header with named fields and data; chunks hold
connections and messages; an index follows them.
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

from engram.sequences.bags.compression import unpacked
from engram.sequences.bags.records import (
    MAX_BYTES,
    DamageError,
    Record,
    Report,
    Topic,
    counted,
    message_type,
)
from engram.untrusted import open_regular

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
_MAX_HEADER = 1_000_000

Fields = dict[bytes, bytes]


class Ros1Bag:
    """A `BagFile` of ROS 1."""

    is_ros1 = True

    def __init__(self, path: Path) -> None:
        self.path = path

    def topics(self, lost: Report) -> dict[str, Topic]:
        """The topics, from the index, or without one from all chunks."""
        with self._open() as file:
            try:
                return self._indexed(file)
            except DamageError:
                connections: dict[int, Topic] = {}
                for _ in self._scan(file, connections, set(), lost):
                    pass  # the scan fills the connections
                lost(f"{self.path}: has no index: it was not closed, or is cut short")
                return {topic.name: topic for topic in connections.values()}

    def records(self, topics: Collection[str] | None, lost: Report) -> Iterator[Record]:
        """The messages in the order of the file; see `BagFile`."""
        with self._open() as file:
            yield from self._scan(file, {}, topics, lost)

    def _open(self) -> BinaryIO:
        file = os.fdopen(open_regular(self.path), "rb")
        if file.read(len(_MAGIC)) != _MAGIC:
            file.close()
            raise DamageError(f"{self.path}: is not a ROS 1 bag of version 2.0")
        return file

    def _indexed(self, file: BinaryIO) -> dict[str, Topic]:
        header, _ = _record(file)
        if header.get(b"op") != bytes([_BAG]):
            raise DamageError("begins with something else than a bag header")
        file.seek(_number(header, b"index_pos", "<Q"))
        if file.tell() == 0:
            raise DamageError("was not closed")
        connections: dict[int, Topic] = {}
        counts: Counter[str] = Counter()
        for _ in range(_number(header, b"conn_count", "<I")):
            _connect(connections, *_record(file))
        for _ in range(_number(header, b"chunk_count", "<I")):
            fields, data = _record(file)
            if fields.get(b"op") != bytes([_CHUNK_INFO]):
                raise DamageError("has a damaged index")
            for number, count in struct.iter_unpack("<II", data[: len(data) // 8 * 8]):
                if number in connections:
                    counts[connections[number].name] += count
        return counted({one.name: one for one in connections.values()}, counts)

    def _scan(
        self,
        file: BinaryIO,
        connections: dict[int, Topic],
        topics: Collection[str] | None,
        lost: Report,
    ) -> Iterator[Record]:
        """Reads all chunks, and fills `connections` from them."""
        end = os.fstat(file.fileno()).st_size
        file.seek(len(_MAGIC))
        while (at := file.tell()) < end:
            try:
                fields, data, whole = _record_or_part(file)
            except DamageError as error:
                lost(f"{self.path}: the last {end - at:,} of {end:,} bytes are lost: {error}")
                return
            if fields.get(b"op") != bytes([_CHUNK]):
                continue
            try:
                kind = fields.get(b"compression", b"none").decode("ascii", "replace")
                content = unpacked(data, kind, _number(fields, b"size", "<I"), whole=whole)
                del data
                yield from _messages(content, connections, topics)
            except DamageError as error:
                lost(f"{self.path}: what follows in the chunk at byte {at:,} is lost: {error}")


def _messages(
    chunk: bytes, connections: dict[int, Topic], topics: Collection[str] | None
) -> Iterator[Record]:
    at = 0
    while at < len(chunk):
        fields, begin, at = _split(chunk, at)
        if fields.get(b"op") == bytes([_CONNECTION]):
            _connect(connections, fields, chunk[begin:at])
        elif fields.get(b"op") == bytes([_MESSAGE]):
            topic = connections.get(_number(fields, b"conn", "<I"))
            if topic is not None and (topics is None or topic.name in topics):
                seconds, nanos = struct.unpack("<II", _field(fields, b"time", 8))
                yield Record(topic.name, seconds * 10**9 + nanos, chunk[begin:at])


def _connect(connections: dict[int, Topic], fields: Fields, data: bytes) -> None:
    if fields.get(b"op") != bytes([_CONNECTION]):
        raise DamageError("has a damaged index")
    stated = _fields(data)
    name = fields.get(b"topic", b"").decode("utf-8", "replace")
    kind = stated.get(b"type", b"").decode("utf-8", "replace")
    topic = Topic("/" + name.lstrip("/"), message_type(kind))
    connections[_number(fields, b"conn", "<I")] = topic


def _record(file: BinaryIO) -> tuple[Fields, bytes]:
    fields, data, whole = _record_or_part(file)
    if not whole:
        raise DamageError("the file is cut short")
    return fields, data


def _record_or_part(file: BinaryIO) -> tuple[Fields, bytes, bool]:
    """Header and data of the next record, and whether the data are all there."""
    header, whole = _sized(file, _MAX_HEADER)
    if not whole:
        raise DamageError("the file is cut short")
    return _fields(header), *_sized(file, MAX_BYTES)


def _sized(file: BinaryIO, most: int) -> tuple[bytes, bool]:
    head = file.read(4)
    if len(head) < 4:
        raise DamageError("the file is cut short")
    (size,) = struct.unpack("<I", head)
    if size > most:
        raise DamageError(f"a record of {size:,} bytes, at most {most:,} are read")
    data = file.read(size)
    return data, len(data) == size


def _split(chunk: bytes, at: int) -> tuple[Fields, int, int]:
    """Header, begin and end of the data of the record at a place of a chunk."""
    try:
        (size,) = struct.unpack_from("<I", chunk, at)
        fields = _fields(chunk[at + 4 : at + 4 + size])
        begin = at + 8 + size
        (length,) = struct.unpack_from("<I", chunk, begin - 4)
    except struct.error:
        raise DamageError("a record in it is cut short") from None
    if begin + length > len(chunk):
        raise DamageError("a record in it is cut short")
    return fields, begin, begin + length


def _fields(header: bytes) -> Fields:
    fields: Fields = {}
    at = 0
    while at + 4 <= len(header):
        (size,) = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4 : at + 4 + size].partition(b"=")
        fields[name] = value
        at += 4 + size
    if at != len(header):
        raise DamageError("a header is damaged")
    return fields


def _field(fields: Fields, name: bytes, size: int) -> bytes:
    value = fields.get(name, b"")
    if len(value) != size:
        raise DamageError(f"{name.decode()} is missing from a header, or of the wrong size")
    return value


def _number(fields: Fields, name: bytes, kind: str) -> int:
    return int(struct.unpack(kind, _field(fields, name, struct.calcsize(kind)))[0])
