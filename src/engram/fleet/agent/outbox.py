"""What a robot and its centre exchange: hand-ins go out, wanted versions come in."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from engram.counts import counted
from engram.errors import MapCorruptError, StorageFullError
from engram.fleet.agent.link import CentreRefusedError, Link
from engram.fleet.agent.state import AgentState
from engram.fleet.transfers import (
    Manifest,
    PartHash,
    Split,
    blobs_named,
    decode_manifest,
    encode_manifest,
    join,
    split,
)
from engram.maps.map_files import check_file

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
        """Queues what the robot's map holds now; None if nothing is new since the last time.

        Raises:
            StorageFullError: the outbox would take more than it may; nothing is lost, the map
                holds it all.
        """
        taken = split(self._live, known=self._state.shared() | self._queued())
        key = taken.manifest.id
        if key == self._state.fact("last_queued") or key in {
            one["id"]
            for one in self._state.outbox()  # handed in before a fall-back
        }:
            return None
        names = [*taken.pages, *taken.blobs]
        parts = dict(zip(names, taken.parts(names), strict=True))
        size = sum(map(len, parts.values()))
        kept = self._make_room(size)
        if kept + size > self._limit_bytes:
            raise StorageFullError(
                f"the outbox would hold {kept + size} bytes, more than {self._limit_bytes}: hand "
                "in after the next sync, or raise outbox_bytes"
            )
        self._state.queue(key, encode_manifest(taken.manifest), parts)
        self._state.remember(last_queued=key)
        return key

    def _make_room(self, size: int) -> int:
        """Drops what the centre did not take, oldest first, as far as needed; bytes then kept."""
        rows = self._state.outbox()
        kept: int = sum(one["bytes"] for one in rows)
        for one in rows:
            refused = one["state"] in {FAILED, SETTLED} and one["revision"] is None
            if refused and kept + size > self._limit_bytes:
                self._state.forget_outbox(one["id"])
                _log.info("hand-in %s, not taken by the centre, makes room", one["id"][:12])
                kept -= one["bytes"]
        return kept

    def send(self, link: Link, durable_revision: int) -> bool:
        """Sends what is queued, oldest first; whether something was handed in.

        What is missing from the centre, as after a restored backup, is sent again. What it refuses
        for what it holds is not, and holds up nothing else.

        Raises:
            CentreRefusedError: for reasons of the centre: it is sent again.
            Unreachable: the link broke. What arrived need not be sent again.
        """
        changed = False
        for row in self._state.outbox():
            never_taken = row["state"] == FAILED and row["id"] not in self._handins()
            if never_taken or (row["state"] != QUEUED and self._look(link, row, durable_revision)):
                continue
            try:
                changed = self._send(link, row) or changed
            except CentreRefusedError as error:
                if error.status != _MALFORMED:
                    raise
                self._note(row, FAILED, None, str(error))
        return changed

    def _note(self, row: dict[str, Any], state: str, revision: int | None, why: Any) -> None:
        """Records the progress of a hand-in, and reports it if it changed."""
        if (row["state"], row["revision"], row["error"]) == (state, revision, why):
            return
        self._state.set_outbox(row["id"], state, revision, why)
        told = "" if revision is None else f", in revision {revision}"
        _log.info("hand-in %s: %s%s%s", row["id"][:12], state, told, f": {why}" if why else "")

    def _queued(self) -> set[PartHash]:
        return {
            one for row in self._state.outbox() for one in self._state.waiting_hashes(row["id"])
        }

    def _send(self, link: Link, row: dict[str, Any]) -> bool:
        """Sends one hand-in; whether it is complete."""
        manifest = decode_manifest(row["manifest"])
        answer = self._begin(link, manifest)
        key = answer["id"]
        if answer["wanted"]:
            _log.info("hand-in %s: sending", row["id"][:12])
        while answer["wanted"]:
            wanted = [PartHash(bytes.fromhex(one)) for one in answer["wanted"]]
            before = answer["wanted"]
            answer = link.send(f"/v1/handins/{key}/parts", partial(self._parts, row, wanted))
            if answer["wanted"] and set(answer["wanted"]) == set(before):
                self._note(
                    row, FAILED, None, f"no longer on this robot: {counted(len(wanted), 'part')}"
                )
                return False
        link.ask("POST", f"/v1/handins/{key}/complete")
        self._state.share([*manifest.hashes(), *self._state.waiting_hashes(row["id"])])
        self._state.remember(
            base=row["manifest"].decode(), handin={**self._handins(), row["id"]: key}
        )
        self._note(row, SENT, None, None)
        return True

    def _begin(self, link: Link, manifest: Manifest) -> dict[str, Any]:
        """Announces a hand-in: as what it adds to a manifest that the centre has, if it does."""
        base = self._state.fact("base")
        path = f"/v1/maps/{self._map}/handins"
        if base is not None:
            try:
                return _as_dict(
                    link.ask("POST", path, _json(manifest, decode_manifest(base.encode())))
                )
            except CentreRefusedError as error:
                if error.status != _MALFORMED:
                    raise
        return _as_dict(link.ask("POST", path, _json(manifest, None)))

    def _parts(self, row: dict[str, Any], wanted: list[PartHash]) -> Iterator[bytes]:
        """Parts from the outbox; what it did not keep, from the robot's map."""
        for one in wanted:
            body = self._state.waiting(row["id"], one)
            if body is not None:
                yield body
                continue
            for other in self._state.outbox():
                body = body or self._state.waiting(other["id"], one)
            if body is not None:
                yield body
                continue
            if self._whole is None or one not in self._whole:
                self._whole = split(self._live)
            yield from self._whole.parts([one])

    def _look(self, link: Link, row: dict[str, Any], durable_revision: int) -> bool:
        """Checks the state of a hand-in; returns whether the centre has it."""
        key = self._handins().get(row["id"])
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
            self._state.forget_outbox(row["id"])
            _log.info("hand-in %s: in a backup, no longer kept here", row["id"][:12])
        elif answer["state"] in _ENDED_BADLY:
            self._note(row, FAILED, None, answer["error"])
        elif answer["state"] in {"merged", "refused"}:
            self._note(row, SETTLED, revision, answer["error"])
        else:
            waits = answer["progress"] if answer["progress"].startswith("waits") else None
            self._note(row, SENT, None, waits)
        return True

    def _handins(self) -> dict[str, str]:
        """Names of the hand-ins at the centre, by outbox entry."""
        kept = {row["id"] for row in self._state.outbox()}
        named: dict[str, str] = self._state.fact("handin", {})
        return {one: key for one, key in named.items() if one in kept}


def _json(manifest: Manifest, base: Manifest | None) -> dict[str, Any]:
    import msgspec

    wire: dict[str, Any] = msgspec.to_builtins(manifest.on_wire(base))
    return wire


def _as_dict(answer: Any) -> dict[str, Any]:
    return dict(answer)


# Parts are kept as often as this much of them has arrived.
_KEEP_BYTES = 256 * 1024
# Hashes in one request: 33 kB, so that a link that breaks often lets it pass.
_ASKED_AT_ONCE = 500


class Fetch:
    """Fetches downloads of one map.

    Args:
        state: of the agent.
        name: of the map at the centre.
        live: the robot's map, whose blobs need not be sent.
    """

    def __init__(self, state: AgentState, name: str, live: Path) -> None:
        self._state = state
        self._map = name
        self._live = live

    def fetch(self, link: Link, revision: int, options: dict[str, Any], path: Path) -> bool:
        """Fetches a revision into a file; whether it is there now.

        Raises:
            CentreRefusedError: the centre cannot make it.
            Unreachable: the link broke. What arrived is kept.
            MapCorruptError: what arrived is not sound.
        """
        asked = {"ref": str(revision), "options": options}
        artifact = link.ask("POST", f"/v1/maps/{self._map}/downloads", asked)
        if artifact["state"] == "failed":
            raise MapCorruptError(
                f"the centre cannot make revision {revision}: {artifact['error']}"
            )
        if artifact["state"] != "ready":
            return False
        key = artifact["id"]
        sent = link.ask("GET", f"/v1/artifacts/{key}/manifest")
        manifest = _manifest(sent)
        _log.info("fetching revision %d", revision)
        own = split(self._live) if self._live.exists() else None
        self._receive(link, key, list(manifest.hashes()), own)
        blobs = self._blobs(manifest, own)
        self._receive(link, key, blobs, own)
        self._write(manifest, own, path)
        self._state.share([*manifest.hashes(), *blobs])
        self._state.remember(base=_text(manifest))
        self._state.clear_arrived()
        return True

    def _receive(self, link: Link, key: str, parts: list[PartHash], own: Split | None) -> None:
        here = self._state.arrived_hashes()
        wanted = [
            one
            for one in dict.fromkeys(parts)
            if one not in here and (own is None or one not in own)
        ]
        for at in range(0, len(wanted), _ASKED_AT_ONCE):
            some: list[tuple[PartHash, bytes]] = []
            size = 0
            try:
                asked = wanted[at : at + _ASKED_AT_ONCE]
                for name, body in link.receive(f"/v1/artifacts/{key}/parts", asked):
                    some.append((name, body))
                    size += len(body)
                    if size >= _KEEP_BYTES:
                        self._state.arrive(some)
                        some, size = [], 0
            finally:
                self._state.arrive(some)

    def _blobs(self, manifest: Manifest, own: Split | None) -> list[PartHash]:
        named = blobs_named(manifest, lambda one: self._part(own, one))
        return [blob for _, _, blobs in named for blob in blobs]

    def _write(self, manifest: Manifest, own: Split | None, path: Path) -> None:
        path.unlink(missing_ok=True)
        join(manifest, lambda one: self._part(own, one), path)
        problems = check_file(path).problems
        if problems:
            path.unlink()
            raise MapCorruptError(
                f"the download has {len(problems)} faults ({problems[0]}); it is fetched again"
            )

    def _part(self, own: Split | None, part: PartHash) -> bytes | None:
        body = self._state.arrived(part)
        if body is None and own is not None:
            body = next(own.parts([part]), None)
        return body


def _manifest(sent: Any) -> Manifest:
    import msgspec

    return decode_manifest(msgspec.json.encode(sent))


def _text(manifest: Manifest) -> str:
    from engram.fleet.transfers import encode_manifest

    return encode_manifest(manifest).decode()
