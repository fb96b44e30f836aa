"""What hand-ins bring: their manifests and parts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from sqlalchemy import Connection, select, update

from engram.centre.errors import ConflictError, MalformedError, MissingPartsError, QuotaError
from engram.centre.keeping import HandInState, manifest_key
from engram.centre.service import Centre
from engram.centre.settings import DAY_NS
from engram.centre.store.database import first_row
from engram.centre.store.packs import given_by
from engram.centre.store.schema import handins, usage
from engram.counts import counted
from engram.errors import InputError, MapCorruptError
from engram.maps.schema import frames, nodes, vocabularies
from engram.transfers import Manifest, PartHash
from engram.transfers.manifest import decode_manifest
from engram.transfers.pages import decode_page


class Parts:
    """The manifests and parts of a centre's hand-ins; `HandIns` holds their rows."""

    def __init__(self, centre: Centre) -> None:
        self._centre = centre

    def manifest(self, row: dict[str, Any]) -> Manifest:
        """The manifest of a hand-in."""
        key = manifest_key(row["map"], row["manifest"])
        return decode_manifest(self._centre.objects.get(key))

    def base_of(self, row: dict[str, Any]) -> Manifest:
        """The manifest that it continues; an empty one without."""
        if row["base"] is None:
            return Manifest("", 0, {})
        return decode_manifest(self._centre.objects.get(manifest_key(row["map"], row["base"])))

    def put(self, row: dict[str, Any], some: Sequence[bytes]) -> None:
        """Stores verified parts of a hand-in; those that are there already cost nothing.

        Raises:
            ConflictError: it is complete or has ended.
            InputError: it is larger than any may be.
            QuotaError: more than the robot may hand in today.
        """
        if row["state"] != HandInState.OPEN:
            raise ConflictError(f"hand-in {row['id']} is {row['state']} and takes no more parts")
        size, now = sum(map(len, some)), self._centre.now_ns()
        with self._centre.database.reading() as connection:
            used = _used(connection, row["robot"], now)
            whole = first_row(connection, select(handins.c.bytes).where(handins.c.id == row["id"]))
        limits = self._centre.settings
        if used + size > limits.bytes_a_day:
            raise QuotaError(
                f"{used + size} bytes today; {limits.bytes_a_day} are granted: continue tomorrow"
            )
        if whole is not None and whole["bytes"] + size > limits.handin_bytes:
            raise InputError(
                f"the hand-in is larger than {limits.handin_bytes} bytes; hand in more often"
            )
        new = self._centre.packs(row["map"]).add(some, now, row["robot"])
        with self._centre.database.writing(durable=False) as connection:
            connection.execute(
                update(handins).where(handins.c.id == row["id"]).values(bytes=handins.c.bytes + new)
            )
            used = _used(connection, row["robot"], now) + new
            day = {"subject": row["robot"], "day": now // DAY_NS, "bytes": used}
            self._centre.database.put(connection, usage, day)

    def wanted(self, row: dict[str, Any]) -> list[PartHash]:
        """Parts that the robot has yet to send: pages first, then the blobs that they name.

        Of frames only those of nodes that are new to the fleet map; it takes no others.
        """
        if row["state"] != HandInState.OPEN:
            return []
        manifest, base = self.manifest(row), set(self.base_of(row).hashes())
        fresh = [one for one in dict.fromkeys(manifest.hashes()) if one not in base]
        lacking = self._not_given(row, fresh)
        if lacking:
            return lacking
        new = set(fresh)
        named = self.blobs_needed(row, manifest, new)
        return self._not_given(row, list(dict.fromkeys(named)))

    def blobs_needed(
        self, row: dict[str, Any], manifest: Manifest, pages: set[PartHash] | None = None
    ) -> list[PartHash]:
        """Blobs that merging reads.

        Args:
            row: the hand-in.
            manifest: its manifest.
            pages: only blobs that these pages name; None for all.

        Raises:
            MalformedError: a page does not hold rows of its table.
        """
        packs = self._centre.packs(row["map"])

        def rows(name: str, some: set[PartHash] | None) -> Iterable[tuple[Any, ...]]:
            table = {"nodes": nodes, "frames": frames, "vocabularies": vocabularies}[name]
            wanted = [one for one in manifest.pages.get(name, ()) if some is None or one in some]
            for _, body in packs.read(wanted):
                try:
                    yield from decode_page(table, body)
                except MapCorruptError as error:
                    raise MalformedError(str(error)) from error

        own = {one[1]: one[0] for one in rows("nodes", None)}
        with self._centre.reading(row["map"]) as store:
            held = {own[uuid] for uuid in store.known_among(list(own))}
        found = []
        for one in rows("frames", pages):
            if one[0] not in held:
                found += [PartHash(blob) for blob in one[2:4] if blob is not None]
        return found + [PartHash(one[3]) for one in rows("vocabularies", pages)]

    def source(self, row: dict[str, Any], manifest: Manifest) -> dict[PartHash, bytes]:
        """Pages and blobs of a hand-in that it may use: given by its robot, or of its base."""
        base = self.base_of(row)
        pages = list(dict.fromkeys(manifest.hashes()))
        trusted = set(base.hashes())
        self._refuse_foreign(row, [one for one in pages if one not in trusted])
        blobs = self.blobs_needed(row, manifest)
        of_base = set(self.blobs_needed(row, base)) if base.pages else set()
        self._refuse_foreign(row, [one for one in blobs if one not in of_base])
        return dict(self._centre.packs(row["map"]).read([*pages, *dict.fromkeys(blobs)]))

    def _refuse_foreign(self, row: dict[str, Any], some: list[PartHash]) -> None:
        lacking = self._not_given(row, some)
        if lacking:
            raise MissingPartsError(f"{counted(len(lacking), 'part')} missing")

    def _not_given(self, row: dict[str, Any], some: list[PartHash]) -> list[PartHash]:
        with self._centre.database.reading() as connection:
            had = given_by(connection, row["map"], row["robot"], some)
        return [one for one in some if one not in had]


def _used(connection: Connection, robot: str, now_ns: int) -> int:
    query = select(usage.c.bytes).where(usage.c.subject == robot, usage.c.day == now_ns // DAY_NS)
    return connection.execute(query).scalar() or 0
