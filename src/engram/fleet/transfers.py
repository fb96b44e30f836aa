"""Maps on the wire: pages of rows and blobs, each known by its SHA-256; what robots sign.

Rows are only ever added to a map, so a page that is full stays as it is: whoever has it once need
not get it again. Pages begin again wherever the rows so far fill one, which depends on these rows
alone. Blobs (landmarks, thumbnails, vocabularies) are parts of their own; pages hold their hashes.

Bundles: parts one after another in one body, each usable as soon as it has arrived. A part is its
SHA-256 (32 bytes), its size, the size of what follows (4 bytes each, big-endian), and the part
itself, deflated where that is shorter. A body that breaks off loses one part at most.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NewType, TypeAlias

import msgspec
from sqlalchemy import Table

from engram.errors import InputError, MapCorruptError, MapError, extra
from engram.maps.exchange import EXCHANGED, MapRows, Values, map_of_rows
from engram.maps.map import Map
from engram.maps.schema import VERSIONED, frames, revisions, vocabularies

# SHA-256 of a part's bytes.
PartHash = NewType("PartHash", bytes)

# Large enough that a manifest stays short, small enough that the last page of each table, which is
# sent again as it fills, costs little.
PAGE_BYTES = 8192
# Of one part: the longest attempts of a session and the vocabulary fit.
MAX_PART_BYTES = 16 * 2**20
# So many characters of an id are shown: the centre finds a hand-in by them.
SHORT = 8
# Columns whose values are parts of their own.
BLOBS: dict[Table, tuple[str, ...]] = {frames: ("landmarks", "thumbnail"), vocabularies: ("body",)}
TABLES: dict[str, Table] = {table.name: table for table in EXCHANGED}

_Int64 = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
_encode = msgspec.msgpack.Encoder().encode
_HEAD_BYTES = 5  # of a page, before its rows


def part_hash(body: bytes) -> PartHash:
    """The name of a part."""
    return PartHash(hashlib.sha256(body).digest())


def handin_id(name: str, robot: str, manifest: str) -> str:
    """The name of a hand-in, which robot and centre both compute.

    Args:
        name: of the map.
        robot: its id.
        manifest: id of the manifest.
    """
    return hashlib.sha256(f"{name} {robot} {manifest}".encode()).hexdigest()[:32]


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
    head = bytes([0xDD]) + len(rows).to_bytes(_HEAD_BYTES - 1, "big")
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


FORMAT = "engram-parts-1"
_HASH_DIGITS = 64


@dataclass(frozen=True, slots=True)
class Manifest:
    """The pages of a map, which name its blobs.

    Attributes:
        content_hash: of the map.
        revision: the last revision that it holds.
        pages: hashes of the pages of each table that has rows, in order.
    """

    content_hash: str
    revision: int
    pages: Mapping[str, tuple[PartHash, ...]]

    @property
    def id(self) -> str:
        """SHA-256 of the manifest, 64 hexadecimal digits: equal for equal maps."""
        body = msgspec.json.encode(self.on_wire(None), order="sorted")
        return hashlib.sha256(body).hexdigest()

    def hashes(self) -> Iterator[PartHash]:
        """All pages, tables in their order."""
        for table in TABLES:
            yield from self.pages.get(table, ())

    def on_wire(self, base: Manifest | None) -> WireManifest:
        """The manifest, short where it continues another one that the other side has."""
        tables = {}
        for name, pages in self.pages.items():
            kept = 0 if base is None else _common(base.pages.get(name, ()), pages)
            tables[name] = WirePages(kept, [page.hex() for page in pages[kept:]])
        known = None if base is None else base.id
        return WireManifest(FORMAT, self.content_hash, self.revision, tables, known)


@dataclass(frozen=True, slots=True)
class WirePages:
    """Pages of one table: as many as the base has, then these."""

    kept: int = 0
    pages: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class WireManifest:
    """A manifest as sent: JSON.

    Attributes:
        format: "engram-parts-1".
        content_hash: of the map, 32 hexadecimal digits.
        revision: the last revision of the map.
        tables: pages by table.
        base: id of the manifest that this one continues; None for none.
    """

    format: str
    content_hash: str
    revision: int
    tables: dict[str, WirePages]
    base: str | None = None

    def full(self, base: Manifest | None) -> Manifest:
        """The manifest.

        Args:
            base: the one that `base` names; None without one.

        Raises:
            InputError: it is of another format, names another base, or is malformed.
        """
        if self.format != FORMAT:
            raise InputError(f"the manifest is of format {self.format!r:.40}, this reads {FORMAT}")
        if (None if base is None else base.id) != self.base:
            raise InputError("the manifest continues one that is not known here; send it whole")
        if unknown := self.tables.keys() - TABLES.keys():
            raise InputError(f"a map does not have the tables {sorted(unknown)!r:.80}")
        pages = {name: self._pages(name, base) for name in TABLES if name in self.tables}
        return Manifest(self.content_hash, self.revision, pages)

    def _pages(self, name: str, base: Manifest | None) -> tuple[PartHash, ...]:
        given = self.tables[name]
        before = () if base is None else base.pages.get(name, ())
        if not 0 <= given.kept <= len(before):
            raise InputError(f"{name}: {given.kept} pages kept of {len(before)}")
        return before[: given.kept] + tuple(_hash(page) for page in given.pages)


def decode_manifest(body: bytes) -> Manifest:
    """A whole manifest from its JSON.

    Raises:
        MapCorruptError: it is not a valid manifest.
    """
    try:
        return msgspec.json.decode(body, type=WireManifest).full(None)
    except (msgspec.DecodeError, RecursionError, InputError) as error:
        raise MapCorruptError(f"not a manifest: {error}") from error


def encode_manifest(manifest: Manifest) -> bytes:
    """Undoes `decode_manifest`."""
    return msgspec.json.encode(manifest.on_wire(None), order="sorted")


def _common(ours: tuple[PartHash, ...], theirs: tuple[PartHash, ...]) -> int:
    """How many pages at the beginning are equal."""
    for at, (our, their) in enumerate(zip(ours, theirs, strict=False)):
        if our != their:
            return at
    return min(len(ours), len(theirs))


def _hash(text: str) -> PartHash:
    try:
        found = bytes.fromhex(text)
    except ValueError:
        found = b""
    if len(text) != _HASH_DIGITS or len(found) * 2 != _HASH_DIGITS:
        raise InputError(f"{text!r:.80} is not a SHA-256 in {_HASH_DIGITS} hexadecimal digits")
    return PartHash(found)


# The part of this hash; None where it is missing.
Source: TypeAlias = Callable[[PartHash], bytes | None]


class MissingPartError(MapError):
    """A part that the map needs is not there."""

    def __init__(self, part: PartHash) -> None:
        super().__init__(f"part {part.hex()[:16]}… is missing")
        self.part = part


def join(manifest: Manifest, source: Source, path: Path, *, thin: bool = False) -> None:
    """Writes the map of a manifest. Whole or not at all.

    Args:
        manifest: what it consists of.
        source: gives the parts, verified against their hashes.
        path: the file, which must not exist.
        thin: whether frames may be missing; their nodes are then without.

    Raises:
        MissingPartError: a part is missing.
        MapCorruptError: parts do not make a map, or not the one of the manifest.
        MapError: it cannot be written.
    """
    with map_of_rows(path) as put:
        for name, table in TABLES.items():
            for page in manifest.pages.get(name, ()):
                slim = decode_page(table, _needed(source, page))
                put(table, whole_rows(table, slim, source, thin=thin))
    try:
        with Map.open(path, at=None) as store:
            found = store.verified_hash()
        if found != manifest.content_hash:
            raise MapCorruptError(
                f"the parts make a map of content {found}, not {manifest.content_hash!r:.40}"
            )
    except BaseException:
        path.unlink()
        raise


def blobs_named(manifest: Manifest, source: Source) -> Iterator[tuple[str, int, list[PartHash]]]:
    """Table and key of each row with blobs, and their hashes.

    Raises:
        MissingPartError: a page is missing.
        MapCorruptError: a page does not hold rows of its table.
    """
    for table in BLOBS:
        for page in manifest.pages.get(table.name, ()):
            for row in decode_page(table, _needed(source, page)):
                yield table.name, row[0], blobs_of(table, row)


def blobs_of(table: Table, row: Values) -> list[PartHash]:
    """Hashes of the blobs of a row as it is in pages."""
    return [row[at] for at in _blob_places(table) if row[at] is not None]


def _blob_places(table: Table) -> list[int]:
    return [table.columns.keys().index(name) for name in BLOBS.get(table, ())]


def slim_row(table: Table, row: Values) -> Values:
    """A row as it is in pages: the hashes of its blobs in their places."""
    if table not in BLOBS:
        return row
    slim = list(row)
    for at in _blob_places(table):
        if slim[at] is not None:
            slim[at] = part_hash(slim[at])
    return slim


def whole_rows(
    table: Table, rows: Iterable[Values], source: Source, *, thin: bool = False
) -> Iterator[Values]:
    """Undoes `slim_row`; without frames that are missing if `thin`.

    Raises:
        MissingPartError: another blob is missing.
    """
    places = _blob_places(table)
    for slim in rows:
        row = list(slim)
        try:
            for at in places:
                if row[at] is not None:
                    row[at] = _needed(source, PartHash(row[at]))
        except MissingPartError:
            if thin and table is frames:
                continue
            raise
        yield row


def _needed(source: Source, part: PartHash) -> bytes:
    found = source(part)
    if found is None:
        raise MissingPartError(part)
    return found


@dataclass(slots=True)
class Split:
    """A map and its parts. Blobs stay in the map and are read when requested.

    Attributes:
        location: the map file.
        manifest: what it consists of.
        pages: new pages by hash.
        blobs: table, key and column of each new blob, by hash.
    """

    location: Path
    manifest: Manifest
    pages: dict[PartHash, bytes] = field(default_factory=dict)
    blobs: dict[PartHash, tuple[Table, int, int]] = field(default_factory=dict)

    def __contains__(self, part: object) -> bool:
        return part in self.pages or part in self.blobs

    def parts(self, wanted: Sequence[PartHash]) -> Iterator[bytes]:
        """The wanted parts that it has, in their order."""
        with closing(MapRows(self.location, self.manifest.revision)) as rows:
            for part in wanted:
                if part in self.pages:
                    yield self.pages[part]
                elif part in self.blobs:
                    table, key, at = self.blobs[part]
                    yield rows.one(table, key)[at]


@dataclass(frozen=True, slots=True)
class Kept:
    """The pages of a table that stay whatever is added, and the key from which on rows follow."""

    pages: tuple[PartHash, ...] = ()
    since: int | None = None


# Rows of the others come, change and go without a revision.
ONLY_ADDED = (revisions, *VERSIONED)


def full_pages(manifest: Manifest, source: Source) -> dict[str, Kept]:
    """The pages of a map, by table, that a later revision of it has as well.

    Raises:
        MissingPartError: the last page of a table is missing.
    """
    found = {}
    for table in ONLY_ADDED:
        pages = manifest.pages.get(table.name, ())
        if not pages:
            continue
        body = _needed(source, pages[-1])
        rows = decode_page(table, body)
        is_full = len(body) - _HEAD_BYTES >= PAGE_BYTES
        key = rows[-1][0] + 1 if is_full else rows[0][0]
        found[table.name] = Kept(pages if is_full else pages[:-1], key)
    return found


def split(
    location: Path,
    at: int | None = None,
    known: Collection[PartHash] = (),
    kept: Mapping[str, Kept] | None = None,
) -> Split:
    """Takes a map apart.

    Args:
        location: the map file; another process may write to it.
        at: the last revision to hand over; None for the newest.
        known: parts that the other side has, which are left out of `pages` and `blobs`.
        kept: pages that the map is known to have, by table: their rows are not read.

    Raises:
        MapError: the map cannot be read or is damaged.
    """
    found = Split(location, Manifest("", 0, {}))
    pages: dict[str, tuple[PartHash, ...]] = {}
    with closing(MapRows(location, at)) as rows:
        for table in EXCHANGED:
            before = (kept or {}).get(table.name, Kept())
            hashes, own = list(before.pages), rows.of(table, before.since)
            for page in encode_pages(_slim(found, table, row, known) for row in own):
                name = part_hash(page)
                hashes.append(name)
                if name not in known:
                    found.pages[name] = page
            if hashes:
                pages[table.name] = tuple(hashes)
        revision = rows.revision
    with Map.open(location, at=revision) as store:
        found.manifest = Manifest(store.content_hash(), revision, pages)
    return found


def _slim(found: Split, table: Table, row: Values, known: Collection[PartHash]) -> Values:
    """The row as it is in pages; notes its blobs."""
    slim = slim_row(table, row)
    for at in _blob_places(table):
        if slim[at] is not None and slim[at] not in known:
            found.blobs[slim[at]] = (table, row[0], at)
    return slim


KEY_BYTES = 32
SIGNATURE_BYTES = 64


def enrolment_text(code: str) -> bytes:
    """What a robot signs to enrol: that it holds the key whose public half it sends."""
    return b"engram enrol " + code.encode()


def token_text(robot: str, nonce: str) -> bytes:
    """What a robot signs to get a token."""
    return f"engram token {robot} {nonce}".encode()


def check_signature(public_key: bytes, signature: bytes, text: bytes) -> None:
    """Refuses a signature that is not of this key.

    Raises:
        InputError: it is not.
    """
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    try:
        Ed25519PublicKey.from_public_bytes(public_key).verify(signature, text)
    except (InvalidSignature, ValueError) as error:
        raise InputError("the signature is not of this key") from error


class Signer:
    """A robot's key pair.

    Args:
        private_key: 32 bytes; `new_key` makes them.
    """

    def __init__(self, private_key: bytes) -> None:
        self._key = _ed25519().Ed25519PrivateKey.from_private_bytes(private_key)

    @staticmethod
    def new_key() -> bytes:
        """A new private key, 32 bytes."""
        made: bytes = _ed25519().Ed25519PrivateKey.generate().private_bytes_raw()
        return made

    @property
    def public_key(self) -> bytes:
        """32 bytes."""
        found: bytes = self._key.public_key().public_bytes_raw()
        return found

    def sign(self, text: bytes) -> bytes:
        """The signature, 64 bytes."""
        made: bytes = self._key.sign(text)
        return made


def _ed25519() -> Any:
    """The module; the key pairs of robots alone need it."""
    with extra("agent", "keys of robots need cryptography"):
        from cryptography.hazmat.primitives.asymmetric import ed25519
    return ed25519
