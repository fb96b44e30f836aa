"""Fetches the wanted version and places it next to the live map."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from engram.agent.link import Link
from engram.agent.state import AgentState
from engram.errors import MapCorruptError
from engram.maps import check_file
from engram.transfers import Manifest, PartHash, Split, join, split
from engram.transfers.join import blobs_named
from engram.transfers.manifest import decode_manifest

_log = logging.getLogger(__name__)
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
    from engram.transfers.manifest import encode_manifest

    return encode_manifest(manifest).decode()
