"""MCAP files of ROS 2, or converted from ROS 1, from front to back.

Source: mcap.dev, "MCAP format specification": records of an opcode, a length and content; chunks
hold schemas, channels and messages; a summary may follow.
"""

from __future__ import annotations

import os
import struct
from binascii import crc32
from collections.abc import Collection, Iterator
from io import BytesIO
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
    topic_of,
)
from engram.untrusted import open_regular

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _STATISTICS, _DATA_END = 2, 3, 4, 5, 6, 11, 15
_FOOTER_BYTES = 9 + 20


class _Contents:
    """Schemas and channels met so far."""

    def __init__(self) -> None:
        self.schemas: dict[int, str] = {}
        self.channels: dict[int, Topic] = {}
        self.encodings: dict[int, str] = {}
        self.counts: dict[int, int] | None = None

    def note(self, code: int, content: bytes) -> None:
        """Takes in a schema, channel or statistics record; ignores others."""
        parts = _Parts(content)
        if code == _SCHEMA:
            number = parts.number("<H")
            self.schemas[number] = message_type(parts.text())
        elif code == _CHANNEL:
            number, schema = parts.number("<H"), parts.number("<H")
            name = parts.text()
            self.encodings[number] = parts.text()
            self.channels[number] = Topic(name, self.schemas.get(schema, "unknown"))
        elif code == _STATISTICS:
            parts.skip(42)
            table = parts.sized("<I")
            self.counts = dict(struct.iter_unpack("<HQ", table[: len(table) // 10 * 10]))

    def topics(self, encoding: str) -> dict[str, Topic]:
        """The topics by name, with counts if statistics were met.

        Args:
            encoding: of the messages that are read.
        """
        found = {
            topic.name: topic_of(topic.name, topic.type, self.encodings[number], encoding)
            for number, topic in self.channels.items()
        }
        if self.counts is None:
            return found
        counts: dict[str, int] = {}
        for number, topic in self.channels.items():
            counts[topic.name] = counts.get(topic.name, 0) + self.counts.get(number, 0)
        return counted(found, counts)


class McapBag:
    """A `BagFile` in MCAP, of ROS 2 or converted from ROS 1, which `topics` finds out."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_ros1 = False

    def topics(self, lost: Report) -> dict[str, Topic]:
        """The topics, from the summary, or without one from all chunks."""
        contents = _Contents()
        with self._open() as file:
            if not self._read_summary(file, contents):
                contents = _Contents()
                for _ in self._scan(file, contents, set(), lost):
                    pass  # the scan fills the contents
        met = set(contents.encodings.values())
        self.is_ros1 = "ros1" in met and "cdr" not in met
        if met and not met & {"cdr", "ros1"}:
            raise DamageError(
                f"{self.path}: messages are encoded as {', '.join(sorted(met))}; only those of "
                "ROS 2 (cdr) and ROS 1 (ros1) are read"
            )
        return contents.topics("ros1" if self.is_ros1 else "cdr")

    def records(self, topics: Collection[str] | None, lost: Report) -> Iterator[Record]:
        """The messages in the order of the file; see `BagFile`."""
        with self._open() as file:
            yield from self._scan(file, _Contents(), topics, lost)

    def _open(self) -> BinaryIO:
        file = os.fdopen(open_regular(self.path), "rb")
        if file.read(len(_MAGIC)) != _MAGIC:
            file.close()
            raise DamageError(f"{self.path}: is not an MCAP file")
        return file

    def _read_summary(self, file: BinaryIO, contents: _Contents) -> bool:
        """Whether the file was closed, and its summary holds channels and statistics."""
        end = os.fstat(file.fileno()).st_size
        if end < len(_MAGIC) * 2 + _FOOTER_BYTES:
            return False
        file.seek(end - len(_MAGIC) - _FOOTER_BYTES)
        footer = file.read()
        if footer[-len(_MAGIC) :] != _MAGIC or footer[0] != _FOOTER:
            return False
        (start,) = struct.unpack_from("<Q", footer, 9)
        if not len(_MAGIC) < start < end:
            return False
        file.seek(start)
        try:
            while (head := file.read(9)) and head[0] != _FOOTER:
                contents.note(head[0], _content(file, head))
        except DamageError:
            return False
        return bool(contents.channels) and contents.counts is not None

    def _scan(
        self,
        file: BinaryIO,
        contents: _Contents,
        topics: Collection[str] | None,
        lost: Report,
    ) -> Iterator[Record]:
        """Reads all chunks, and fills `contents` from them."""
        end = os.fstat(file.fileno()).st_size
        file.seek(len(_MAGIC))
        while (at := file.tell()) < end:
            try:
                head = file.read(9)
                content, whole = _content_or_part(file, head)
                if not (whole or head[0] == _CHUNK):
                    raise DamageError("the file is cut short")
            except DamageError as error:
                lost(f"{self.path}: the last {end - at:,} of {end:,} bytes are lost: {error}")
                return
            if head[0] in {_DATA_END, _FOOTER}:
                return
            try:
                if head[0] == _CHUNK:
                    yield from _chunk(content, contents, topics, whole=whole)
                else:
                    yield from _records(head[0], content, contents, topics)
            except DamageError as error:
                lost(f"{self.path}: what follows in the chunk at byte {at:,} is lost: {error}")
        lost(f"{self.path}: has no end: it was not closed, or is cut short")


def _chunk(
    content: bytes, contents: _Contents, topics: Collection[str] | None, *, whole: bool
) -> Iterator[Record]:
    parts = _Parts(content)
    parts.skip(16)
    size = parts.number("<Q")
    checksum = parts.number("<I")
    kind = parts.text()
    chunk = unpacked(parts.sized("<Q", whole=whole), kind, size, whole=whole)
    if whole and checksum and crc32(chunk) != checksum:
        raise DamageError("its checksum does not match")
    file = BytesIO(chunk)
    while head := file.read(9):
        yield from _records(head[0], _content(file, head), contents, topics)


def _records(
    code: int, content: bytes, contents: _Contents, topics: Collection[str] | None
) -> Iterator[Record]:
    if code != _MESSAGE:
        contents.note(code, content)
        return
    if len(content) < 22:
        raise DamageError("a message is cut short")
    channel, _, received_ns, _ = struct.unpack_from("<HIQQ", content)
    topic = contents.channels.get(channel)
    if topic is not None and (topics is None or topic.name in topics):
        yield Record(topic.name, received_ns, content[22:])


def _content(file: BinaryIO, head: bytes) -> bytes:
    """The content of a record whose opcode and length were read."""
    content, whole = _content_or_part(file, head)
    if not whole:
        raise DamageError("the file is cut short")
    return content


def _content_or_part(file: BinaryIO, head: bytes) -> tuple[bytes, bool]:
    """The readable part of the content, and whether that is all of it."""
    if len(head) < 9:
        raise DamageError("the file is cut short")
    (size,) = struct.unpack_from("<Q", head, 1)
    if size > MAX_BYTES:
        raise DamageError(f"a record of {size:,} bytes, at most {MAX_BYTES:,} are read")
    content = file.read(size)
    return content, len(content) == size


class _Parts:
    """The parts of a record, one after another."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def skip(self, size: int) -> None:
        """Passes over some bytes."""
        self._at += size

    def number(self, kind: str) -> int:
        """The next number."""
        try:
            (value,) = struct.unpack_from(kind, self._content, self._at)
        except struct.error:
            raise DamageError("a record is cut short") from None
        self._at += struct.calcsize(kind)
        return int(value)

    def sized(self, kind: str, *, whole: bool = True) -> bytes:
        """The next bytes, whose length comes before them; fewer only if not `whole`."""
        size = self.number(kind)
        part = self._content[self._at : self._at + size]
        if whole and len(part) < size:
            raise DamageError("a record is cut short")
        self._at += size
        return part

    def text(self) -> str:
        """The next text."""
        return self.sized("<I").decode("utf-8", "replace")
