"""The outbox: hand-ins wait in it until a backup of the centre holds them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from engram.counts import counted
from engram.errors import StorageFullError
from engram.fleet.agent.agent_state import AgentState, OutboxEntry
from engram.fleet.agent.centre_link import CentreLink, CentreRefusedError
from engram.fleet.transfers import (
    SHORT,
    Manifest,
    PartHash,
    Split,
    decode_manifest,
    encode_manifest,
    handin_id,
    split,
)

QUEUED, SENT, SETTLED, FAILED = "queued", "sent", "settled", "failed"
_ENDED_BADLY = {"failed", "cancelled"}
# By this a centre refuses a hand-in for what it holds; whatever else hinders it may pass.
_MALFORMED = 422
_log = logging.getLogger(__name__)


class Outbox:
    """Queues hand-ins and sends them.

    Args:
        state: of the agent.
        name: of the map at the centre.
        live: the robot's map.
        limit_bytes: disk that the outbox may take.
    """

    def __init__(self, state: AgentState, name: str, live: Path, limit_bytes: int) -> None:
        self._state = state
        self._map = name
        self._live = live
        self._limit_bytes = limit_bytes
        self._whole: Split | None = None

    def queue(self) -> str | None:
        """Queues what the robot's map holds now.

        Returns:
            The id of the hand-in at the centre; None if nothing is new since the last time.

        Raises:
            StorageFullError: the outbox would take more than it may; nothing is lost, the map
                holds it all.
        """
        taken = split(self._live, known=self._state.shared() | self._queued())
        key = taken.manifest.id
        kept = {entry.id for entry in self._state.outbox()}  # handed in before a fall-back
        if key == self._state.facts.last_queued or key in kept:
            return None
        names = [*taken.pages, *taken.blobs]
        parts = dict(zip(names, taken.parts(names), strict=True))
        size = sum(map(len, parts.values()))
        whole = self._make_room(size) + size
        if whole > self._limit_bytes:
            raise StorageFullError(
                f"the outbox would hold {whole} bytes, more than {self._limit_bytes}: hand "
                "in after the next sync, or raise outbox_bytes"
            )
        self._state.queue(key, encode_manifest(taken.manifest), parts)
        self._state.remember(last_queued=key)
        return self.name_of(key)

    def name_of(self, manifest: str) -> str:
        """The id at the centre of the hand-in of a manifest."""
        return handin_id(self._map, self._state.facts.robot or "", manifest)

    def _told(self, entry: OutboxEntry) -> str:
        """A hand-in in the log."""
        return f"hand-in {self.name_of(entry.id)[:SHORT]}"

    def _make_room(self, size: int) -> int:
        """Drops what the centre did not take, oldest first, as far as needed; bytes then kept."""
        entries = self._state.outbox()
        kept = sum(entry.size_bytes for entry in entries)
        for entry in entries:
            refused = entry.state in {FAILED, SETTLED} and entry.revision is None
            if refused and kept + size > self._limit_bytes:
                self._state.forget_outbox(entry.id)
                _log.info("%s, not taken by the centre, makes room", self._told(entry))
                kept -= entry.size_bytes
        return kept

    def send(self, link: CentreLink, durable_revision: int) -> bool:
        """Sends what is queued, oldest first; whether something was handed in.

        What is missing from the centre, as after a restored backup, is sent again. What it refuses
        for what it holds is not, and holds up nothing else.

        Raises:
            CentreRefusedError: for reasons of the centre: it is sent again.
            Unreachable: the link broke. What arrived need not be sent again.
        """
        changed, known = False, self._state.facts.handin
        for entry in self._state.outbox():
            key = known.get(entry.id)
            if key is None and entry.state == FAILED:  # the centre never took it
                continue
            if entry.state != QUEUED and self._look(link, entry, key, durable_revision):
                continue
            try:
                changed = self._send(link, entry) or changed
            except CentreRefusedError as error:
                if error.status != _MALFORMED:
                    raise
                self._note(entry, FAILED, None, str(error))
        return changed

    def _note(self, entry: OutboxEntry, state: str, revision: int | None, why: Any) -> None:
        """Records the progress of a hand-in, and reports it if it changed."""
        if (entry.state, entry.revision, entry.error) == (state, revision, why):
            return
        self._state.set_outbox(entry.id, state, revision, why)
        merged = "" if revision is None else f", in revision {revision}"
        _log.info("%s: %s%s%s", self._told(entry), state, merged, f": {why}" if why else "")

    def _queued(self) -> set[PartHash]:
        entries = self._state.outbox()
        return {part for entry in entries for part in self._state.waiting_hashes(entry.id)}

    def _send(self, link: CentreLink, entry: OutboxEntry) -> bool:
        """Sends one hand-in; whether it is complete."""
        manifest = decode_manifest(entry.manifest)
        answer = self._begin(link, manifest)
        key = answer["id"]
        if answer["wanted"]:
            _log.info("%s: sending", self._told(entry))
        while answer["wanted"]:
            before = set(answer["wanted"])
            wanted = [PartHash(bytes.fromhex(part)) for part in answer["wanted"]]
            parts = partial(self._parts, entry, wanted)
            answer = link.ask("POST", f"/v1/handins/{key}/parts", parts=parts)
            if answer["wanted"] and set(answer["wanted"]) == before:
                why = f"no longer on this robot: {counted(len(wanted), 'part')}"
                self._note(entry, FAILED, None, why)
                return False
        link.ask("POST", f"/v1/handins/{key}/complete")
        self._state.share([*manifest.hashes(), *self._state.waiting_hashes(entry.id)])
        kept = {other.id for other in self._state.outbox()}
        known = {name: its for name, its in self._state.facts.handin.items() if name in kept}
        self._state.remember(base=entry.manifest.decode(), handin={**known, entry.id: key})
        self._note(entry, SENT, None, None)
        return True

    def _begin(self, link: CentreLink, manifest: Manifest) -> dict[str, Any]:
        """Announces a hand-in: as what it adds to a manifest that the centre has, if it does."""
        base, path = self._state.facts.base, f"/v1/maps/{self._map}/handins"
        answer: dict[str, Any]
        if base is not None:
            continued = manifest.on_wire(decode_manifest(base.encode()))
            try:
                answer = link.ask("POST", path, msgspec.to_builtins(continued))
            except CentreRefusedError as error:
                if error.status != _MALFORMED:
                    raise
            else:
                return answer
        answer = link.ask("POST", path, msgspec.to_builtins(manifest.on_wire(None)))
        return answer

    def _parts(self, entry: OutboxEntry, wanted: list[PartHash]) -> Iterator[bytes]:
        """Parts from the outbox; what it did not keep, from the robot's map."""
        for part in wanted:
            body = self._state.waiting(entry.id, part)
            for other in self._state.outbox() if body is None else ():
                body = body or self._state.waiting(other.id, part)
            if body is not None:
                yield body
                continue
            if self._whole is None or part not in self._whole:
                self._whole = split(self._live)
            yield from self._whole.parts([part])

    def _look(
        self, link: CentreLink, entry: OutboxEntry, key: str | None, durable_revision: int
    ) -> bool:
        """Checks the state of a hand-in; returns whether the centre has it."""
        try:
            answer = link.ask("GET", f"/v1/handins/{key}")
        except CentreRefusedError as error:
            if error.status == 404:
                return False
            raise
        if answer["state"] == "open":
            return False
        revision = answer["revision"]
        if answer["state"] == "merged" and revision is not None and revision <= durable_revision:
            self._state.forget_outbox(entry.id)
            _log.info("%s: in a backup, no longer kept here", self._told(entry))
        elif answer["state"] in _ENDED_BADLY:
            self._note(entry, FAILED, None, answer["error"])
        elif answer["state"] in {"merged", "refused"}:
            self._note(entry, SETTLED, revision, answer["error"])
        else:
            waits = answer["progress"] if answer["progress"].startswith("waits") else None
            self._note(entry, SENT, None, waits)
        return True
