"""Manifests: what a map consists of."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import msgspec

from engram.errors import InputError, MapCorruptError
from engram.transfers.pages import TABLES, PartHash

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
            tables[name] = WirePages(kept, [one.hex() for one in pages[kept:]])
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
        return before[: given.kept] + tuple(_hash(one) for one in given.pages)


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
    for at, (one, other) in enumerate(zip(ours, theirs, strict=False)):
        if one != other:
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
