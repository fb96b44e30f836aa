"""Bag files, read from front to back: ROS 1, and ROS 2 in SQLite or MCAP; split ones, too.

Containers are read from front to back, bounded in memory, so that a file that was cut short or
damaged gives what it still holds. Each reader's output equals that of `rosbags` on sound files;
`rosbags` itself refuses unsound ones, and unpacks chunks of any size.

MCAP files of ROS 2, or converted from ROS 1, from front to back. Source: mcap.dev, "MCAP format
specification": records of an opcode, a length and content; chunks hold schemas, channels and
messages; a summary may follow.

ROS 1 bags, format 2.0, from front to back. Source: ROS wiki, "Bags/Format/2.0": records of a header
with named fields and data; chunks hold connections and messages; an index follows them.

SQLite files of ROS 2 bags (`.db3`), row by row. Source: rosbag2_storage_sqlite3: tables `topics`
(id, name, type, serialization_format, …) and `messages` (id, topic_id, timestamp, data).
"""

from __future__ import annotations

import bz2
import os
import re
import shutil
import sqlite3
import struct
import sys
from binascii import crc32
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, BinaryIO, Protocol

from engram.errors import MissingExtraError, SequenceError
from engram.sqlite import names_another_file
from engram.untrusted import open_regular

# A chunk or message of this size holds 64 megapixels in colour: no camera sends more.
MAX_BYTES = 256_000_000

Report = Callable[[str], None]


class DamageError(Exception):
    """A part of a bag cannot be read; says which and why."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag.

    Attributes:
        count: number of its messages; None if the bag has no index.
    """

    name: str
    type: str
    count: int | None = None


@dataclass(frozen=True, slots=True)
class Record:
    """One message of a bag, not decoded.

    Attributes:
        received_ns: when it was recorded, ns.
    """

    topic: str
    received_ns: int
    data: bytes


class BagFile(Protocol):
    """One file of a bag.

    Attributes:
        is_ros1: whether its messages are serialised as in ROS 1, else as CDR.
    """

    path: Path
    is_ros1: bool

    def topics(self, lost: Report) -> dict[str, Topic]:
        """The topics by name.

        Raises:
            DamageError: the file is of another kind, or nothing can be read.
        """
        ...

    def records(self, topics: Collection[str] | None, lost: Report) -> Iterator[Record]:
        """The records of some topics (None: of all) in the order of the file.

        Args:
            topics: names of topics; records of others are passed over undecoded.
        """
        ...


def message_type(name: str) -> str:
    """A type's name as in ROS 2: sensor_msgs/Image → sensor_msgs/msg/Image."""
    package, _, kind = name.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{kind}" if package else name


def topic_of(name: str, kind: str, encoding: str, read: str) -> Topic:
    """A topic; the type of one whose messages are not encoded as those that are read says so."""
    return Topic(name, kind if encoding == read else f"{kind} in {encoding or 'no encoding'}")


def counted(topics: dict[str, Topic], counts: dict[str, int]) -> dict[str, Topic]:
    """The topics with the number of their messages."""
    return {name: Topic(name, topic.type, counts.get(name, 0)) for name, topic in topics.items()}


ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
ENDINGS = (".zstd", ".zst")
# A file that grows more is no recording: images with the noise of a sensor shrink to a tenth.
_MOST_RATIO = 200
_BLOCK = 4_000_000


def needs_bags(error: ImportError) -> MissingExtraError:
    """The error to raise if a package of the extra `bags` is not installed."""
    return MissingExtraError(
        f"reading ROS bags needs {error.name or 'rosbags'}: pip install 'engram-localisation[bags]'"
    )


def unpacked(data: bytes, kind: str, size: int | None = None, *, whole: bool = True) -> bytes:
    """The content of a compressed block.

    Args:
        kind: "none" or "", "bz2", "lz4" (frames), "zstd".
        size: its stated size; None if it states none.
        whole: whether all of it is there; of a part, what unpacks is returned.

    Raises:
        DamageError: it is damaged, of an unknown kind, or not of the stated size.
        MissingExtraError: the extra `bags` is not installed.
    """
    most = MAX_BYTES if size is None else size
    if most > MAX_BYTES:
        raise DamageError(f"claims to unpack to {most:,} bytes, at most {MAX_BYTES:,} are read")
    if kind in {"", "none"}:
        content = data
    else:
        unpacker = _unpacker(kind)
        try:
            content = unpacker.decompress(data, max_length=most + 1)
        except Exception as error:  # each library has errors of its own
            raise DamageError(f"its {kind} data are damaged") from error
    if len(content) > most or (whole and size is not None and len(content) != size):
        raise DamageError(f"unpacks to {len(content):,} bytes or more, not to {most:,}")
    return content


def _unpacker(kind: str) -> Any:
    try:
        if kind == "bz2":
            return bz2.BZ2Decompressor()
        if kind == "lz4":
            from lz4.frame import LZ4FrameDecompressor

            return LZ4FrameDecompressor()
        if kind == "zstd":
            return _zstd().ZstdDecompressor()
    except ImportError as error:
        raise needs_bags(error) from error
    raise DamageError(f"is compressed as {kind[:20]!r}; known: bz2, lz4, zstd")


def _zstd() -> Any:
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd


def unpack_file(path: Path, folder: TemporaryDirectory[str]) -> Path:
    """Unpacks NAME.mcap.zstd into a folder; returns the path of NAME.mcap there."""
    out = Path(folder.name) / path.stem
    try:
        zstd = _zstd()
    except ImportError as error:
        raise needs_bags(error) from error
    with os.fdopen(open_regular(path), "rb") as packed, out.open("wb") as file:
        most = _MOST_RATIO * max(os.fstat(packed.fileno()).st_size, 100_000)
        try:
            with zstd.open(packed, "rb") as content:
                while block := content.read(_BLOCK):
                    if file.tell() + len(block) > most:
                        raise SequenceError(
                            f"{path}: unpacks to more than {_MOST_RATIO} times its size: it is "
                            "not a recording"
                        )
                    file.write(block)
        except (zstd.ZstdError, EOFError) as error:
            if not file.tell():
                raise SequenceError(f"{path}: is not a zstd file: {error}") from error
        except OSError as error:
            raise SequenceError(
                f"{path}: cannot be unpacked to {out.parent}: {error.strerror}; set TMPDIR to a "
                "folder with more space"
            ) from error
    return out


_MCAP_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK, _STATISTICS, _DATA_END = (
    2,
    3,
    4,
    5,
    6,
    11,
    15,
)
_FOOTER_BYTES = 9 + 20


class _Contents:
    """Schemas and channels met so far."""

    def __init__(self) -> None:
        self.schemas: dict[int, str] = {}
        self.channels: dict[int, Topic] = {}
        self.encodings: dict[int, str] = {}
        self.counts: dict[int, int] | None = None

    def note(self, code: int, content: bytes) -> None:
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
        topics = {
            topic.name: topic_of(topic.name, topic.type, self.encodings[number], encoding)
            for number, topic in self.channels.items()
        }
        if self.counts is None:
            return topics
        counts: dict[str, int] = {}
        for number, topic in self.channels.items():
            counts[topic.name] = counts.get(topic.name, 0) + self.counts.get(number, 0)
        return counted(topics, counts)


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
        if file.read(len(_MCAP_MAGIC)) != _MCAP_MAGIC:
            file.close()
            raise DamageError(f"{self.path}: is not an MCAP file")
        return file

    def _read_summary(self, file: BinaryIO, contents: _Contents) -> bool:
        """Whether the file was closed, and its summary holds channels and statistics."""
        end = os.fstat(file.fileno()).st_size
        if end < len(_MCAP_MAGIC) * 2 + _FOOTER_BYTES:
            return False
        file.seek(end - len(_MCAP_MAGIC) - _FOOTER_BYTES)
        footer = file.read()
        if footer[-len(_MCAP_MAGIC) :] != _MCAP_MAGIC or footer[0] != _FOOTER:
            return False
        (start,) = struct.unpack_from("<Q", footer, 9)
        if not len(_MCAP_MAGIC) < start < end:
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
        end = os.fstat(file.fileno()).st_size
        file.seek(len(_MCAP_MAGIC))
        while (at := file.tell()) < end:
            try:
                head = file.read(9)
                content, whole = _content_or_part(file, head)
                if not (whole or head[0] == _MCAP_CHUNK):
                    raise DamageError("the file is cut short")
            except DamageError as error:
                lost(f"{self.path}: the last {end - at:,} of {end:,} bytes are lost: {error}")
                return
            if head[0] in {_DATA_END, _FOOTER}:
                return
            try:
                if head[0] == _MCAP_CHUNK:
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
    if code != _MCAP_MESSAGE:
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
    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def skip(self, size: int) -> None:
        self._at += size

    def number(self, kind: str) -> int:
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
        return self.sized("<I").decode("utf-8", "replace")


_ROS1_MAGIC = b"#ROSBAG V2.0\n"
_ROS1_MESSAGE, _BAG, _ROS1_CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
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
        if file.read(len(_ROS1_MAGIC)) != _ROS1_MAGIC:
            file.close()
            raise DamageError(f"{self.path}: is not a ROS 1 bag of version 2.0")
        return file

    def _indexed(self, file: BinaryIO) -> dict[str, Topic]:
        header, _ = _record(file)
        if header.get(b"op") != bytes([_BAG]):
            raise DamageError("does not begin with a bag header")
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
        return counted({connection.name: connection for connection in connections.values()}, counts)

    def _scan(
        self,
        file: BinaryIO,
        connections: dict[int, Topic],
        topics: Collection[str] | None,
        lost: Report,
    ) -> Iterator[Record]:
        end = os.fstat(file.fileno()).st_size
        file.seek(len(_ROS1_MAGIC))
        while (at := file.tell()) < end:
            try:
                fields, data, whole = _record_or_part(file)
            except DamageError as error:
                lost(f"{self.path}: the last {end - at:,} of {end:,} bytes are lost: {error}")
                return
            if fields.get(b"op") != bytes([_ROS1_CHUNK]):
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
        elif fields.get(b"op") == bytes([_ROS1_MESSAGE]):
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


_SQLITE_MAGIC = b"SQLite format 3\x00"
# Rows passed over at a damaged page, doubled until a sound one follows.
_LEAP, _LEAPS = 1, 24


class DatabaseBag:
    """A `BagFile` of ROS 2 in SQLite."""

    is_ros1 = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self._copy: TemporaryDirectory[str] | None = None

    def topics(self, lost: Report) -> dict[str, Topic]:
        """The topics; see `BagFile`."""
        with closing(self._open()) as database:
            try:
                named = self._named(database)
            except sqlite3.Error as error:
                raise DamageError(f"{self.path}: its topics cannot be read: {error}") from error
            try:
                counts = dict(
                    database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id")
                )
            except sqlite3.Error:
                lost(f"{self.path}: is damaged or cut short")
                return {topic.name: topic for topic in named.values()}
        return {
            topic.name: Topic(topic.name, topic.type, counts.get(number, 0))
            for number, topic in named.items()
        }

    def records(self, topics: Collection[str] | None, lost: Report) -> Iterator[Record]:
        """The messages in the order of recording; see `BagFile`."""
        with closing(self._open()) as database:
            try:
                named = self._named(database)
            except sqlite3.Error as error:
                lost(f"{self.path}: its topics cannot be read: {error}")
                return
            wanted = {
                number: topic.name
                for number, topic in named.items()
                if topics is None or topic.name in topics
            }
            yield from self._rows(database, wanted, lost)

    def _open(self) -> sqlite3.Connection:
        with os.fdopen(open_regular(self.path), "rb") as file:
            if file.read(len(_SQLITE_MAGIC)) != _SQLITE_MAGIC:
                raise DamageError(f"{self.path}: is not an SQLite file")
        try:
            logs = _logs_of(self.path)
            if not logs:
                return _connected(self.path, "mode=ro&immutable=1")
            if any(log.name.endswith(_UNDOES) for log in logs):
                if names_another_file(self.path):
                    raise DamageError(f"{self.path}{_UNDOES} names another file; move it away")
                return _connected(self._copied(), "mode=rw")
            # What a killed recorder did not move into the file lies beside it. SQLite reads both
            # only where it can write an index beside them: not on a disk that is read-only.
            database = _connected(self._copied() if self._copy else self.path, "mode=ro")
            try:
                database.execute("SELECT count(*) FROM sqlite_master")
            except sqlite3.OperationalError:
                database.close()
                database = _connected(self._copied(), "mode=ro")
        except sqlite3.Error as error:
            raise DamageError(f"{self.path}: cannot be opened: {error}") from error
        return database

    def _copied(self) -> Path:
        """A copy of the file and its logs in a folder that can be written to; made once."""
        if self._copy is not None:
            return Path(self._copy.name) / self.path.name
        logs = _logs_of(self.path)
        try:
            folder = TemporaryDirectory(prefix="engram-bag-")
            for source in (self.path, *logs):
                target = Path(folder.name) / source.name
                with os.fdopen(open_regular(source), "rb") as read, target.open("xb") as written:
                    shutil.copyfileobj(read, written)
        except OSError as error:
            named = " and ".join(log.name for log in logs)
            raise DamageError(
                f"{self.path}: its last messages depend on {named}, and there is no room for a "
                f"copy of them: {error.strerror}; copy them to a folder that can be written to"
            ) from error
        self._copy = folder
        return Path(folder.name) / self.path.name

    def _named(self, database: sqlite3.Connection) -> dict[int, Topic]:
        tables = {
            name
            for (name,) in database.execute(
                "SELECT name FROM sqlite_master WHERE type = 'table' "
                "AND name IN ('topics', 'messages')"
            )
        }
        if tables != {"topics", "messages"}:
            raise DamageError(f"{self.path}: is an SQLite file, but not a ROS 2 bag")
        rows = list(database.execute("SELECT id, name, type, serialization_format FROM topics"))
        formats = {str(row[3]) for row in rows}
        if formats and "cdr" not in formats:
            raise DamageError(
                f"{self.path}: messages are serialised as {', '.join(sorted(formats))}; only cdr "
                "is read"
            )
        return {
            int(number): topic_of(str(name), message_type(str(kind)), str(form), "cdr")
            for number, name, kind, form in rows
        }

    def _rows(
        self, database: sqlite3.Connection, wanted: dict[int, str], lost: Report
    ) -> Iterator[Record]:
        """Reads by row id; at a damaged page passes over rows until one can be read."""
        marks = ",".join("?" * len(wanted))
        query = (
            "SELECT id, topic_id, timestamp, data FROM messages "
            f"WHERE id > ? AND topic_id IN ({marks}) ORDER BY id"
        )
        last, leap, leaps = -1, _LEAP, 0
        while leaps < _LEAPS:
            try:
                for row, topic, stamp_ns, data in database.execute(query, (last, *wanted)):
                    last, leap = row, _LEAP
                    record = self._record(row, wanted[topic], stamp_ns, data, lost)
                    if record is not None:
                        yield record
                return
            except sqlite3.Error as error:
                if leap == _LEAP:
                    lost(f"{self.path}: rows after {last} are lost: {error}")
                last, leap, leaps = last + leap, leap * 4, leaps + 1

    def _record(
        self, row: int, topic: str, stamp_ns: object, data: object, lost: Report
    ) -> Record | None:
        if not isinstance(stamp_ns, int) or not isinstance(data, bytes):
            lost(f"{self.path}: row {row} holds no message")
            return None
        if data.startswith(ZSTD_MAGIC):
            try:
                data = unpacked(data, "zstd")
            except DamageError as error:
                lost(f"{self.path}: row {row} is lost: {error}")
                return None
        return Record(topic, stamp_ns, data)


# A transaction that was being written to the file itself.
_UNDOES = "-journal"


def _logs_of(path: Path) -> list[Path]:
    """What a killed recorder left next to the file."""
    logs = [path.with_name(path.name + suffix) for suffix in ("-wal", _UNDOES)]
    return [log for log in logs if log.exists() and log.stat().st_size > 0]


def _connected(path: Path, mode: str) -> sqlite3.Connection:
    database = sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_BYTES)
    database.execute("PRAGMA trusted_schema = OFF")
    # Only an interrupted transaction is undone, in a copy. This lets SQLite read one cut short.
    database.execute("PRAGMA writable_schema = ON")
    return database


CONTAINERS: Mapping[str, Callable[[Path], BagFile]] = MappingProxyType(
    {".bag": Ros1Bag, ".mcap": McapBag, ".db3": DatabaseBag}
)
# What a recorder of ROS 1 that was killed leaves at the name.
_UNFINISHED = ".active"
_NUMBER = re.compile(r"_?(\d+)$")
# A damaged file may fail at every chunk; more than these are only counted.
_MOST_LOSSES = 20


def is_bag(path: Path) -> bool:
    """A bag file, or a folder of the files of one bag; checks names only."""
    if path.is_file():
        return _container(path) is not None
    return len(_split_files(path)) > 0


class Bag:
    """All files of a bag.

    Attributes:
        lost: what could not be read so far, without repetitions.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lost: list[str] = []
        self._unpacked: TemporaryDirectory[str] | None = None
        self._files = [self._opened(file) for file in files_of(path)]
        self.topics: dict[str, Topic] = {}
        for file in self._files:
            try:
                self._merge(file.topics(self.note))
            except DamageError as error:
                if len(self._files) == 1:
                    raise SequenceError(str(error)) from error
                self.note(str(error))
        if not self.topics:
            facts = f": {self.lost[0]}" if self.lost else ""
            raise SequenceError(f"{path}: holds no readable message{facts}")

    @property
    def is_ros1(self) -> bool:
        """Whether its messages are serialised as in ROS 1."""
        return self._files[0].is_ros1

    @property
    def size_bytes(self) -> int:
        """Size of its files."""
        return sum(file.path.stat().st_size for file in self._files)

    def records(self, topics: Collection[str] | None = None) -> Iterator[Record]:
        """The messages of some topics (None: of all), file by file, each in its own order."""
        for file in self._files:
            try:
                yield from file.records(topics, self.note)
            except DamageError as error:
                self.note(str(error))

    def note(self, loss: str) -> None:
        """Remembers what could not be read."""
        if loss not in self.lost and len(self.lost) < _MOST_LOSSES:
            self.lost.append(loss)

    def _opened(self, path: Path) -> BagFile:
        if path.suffix in ENDINGS:
            if self._unpacked is None:
                self._unpacked = TemporaryDirectory(prefix="engram-bag-")
            path = unpack_file(path, self._unpacked)
        return CONTAINERS[str(_container(path))](path)

    def _merge(self, topics: Mapping[str, Topic]) -> None:
        for name, topic in topics.items():
            known = self.topics.get(name, Topic(name, topic.type, 0))
            counts = (known.count, topic.count)
            total = None if None in counts else sum(count or 0 for count in counts)
            self.topics[name] = Topic(name, known.type, total)


def files_of(path: Path) -> list[Path]:
    """The files of a bag in order: the file itself, or those of a split bag by number."""
    files = [path] if path.is_file() and _container(path) else _split_files(path)
    if not files:
        raise SequenceError(
            f"{path}: is not a bag: needs a file {', '.join(f'NAME{end}' for end in CONTAINERS)}, "
            "or a folder with the files of one bag"
        )
    return files


def _container(path: Path) -> str | None:
    """Ending of the container that a name stands for, compressed or not, or still recorded."""
    ending = Path(path.stem).suffix if path.suffix in (*ENDINGS, _UNFINISHED) else path.suffix
    return ending if ending in CONTAINERS else None


def _split_files(folder: Path) -> list[Path]:
    """The bag files of a folder that are parts of one bag; none if they are several bags."""
    try:
        files = [file for file in folder.iterdir() if _container(file) and file.is_file()]
    except OSError:
        return []
    stems = {_NUMBER.sub("", _bare(file)) for file in files}
    kinds = {_container(file) for file in files}
    if len(kinds) != 1 or (len(stems) != 1 and not (folder / "metadata.yaml").is_file()):
        return []
    return sorted(files, key=_order)


def _bare(file: Path) -> str:
    return file.name.split(".")[0]


def _order(file: Path) -> tuple[int, str]:
    number = _NUMBER.search(_bare(file))
    return (int(number.group(1)) if number else -1, file.name)
