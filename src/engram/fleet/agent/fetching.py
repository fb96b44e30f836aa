"""Fetching a version of the map: its parts, as far as the robot does not have them."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import msgspec

from engram.errors import MapCorruptError
from engram.fleet.agent.agent_state import AgentState
from engram.fleet.agent.centre_link import CentreLink
from engram.fleet.transfers import (
    PartHash,
    Split,
    blobs_named,
    decode_manifest,
    encode_manifest,
    join,
    split,
)
from engram.maps.map_files import check_file

_log = logging.getLogger(__name__)
# Parts are kept as often as this much of them has arrived.
_KEEP_BYTES = 256 * 1024
# Hashes in one request: 33 kB, so that a link that breaks often lets it pass.
_REQUESTED_AT_ONCE = 500


def fetch_map(
    link: CentreLink,
    state: AgentState,
    request: str,
    wanted: dict[str, Any],
    live: Path,
    path: Path,
) -> bool:
    """Fetches a version into a file; whether it is there now.

    Args:
        link: to the centre.
        state: keeps what has arrived.
        request: path at which the centre takes requests for downloads of the map.
        wanted: ref and options of the download.
        live: the robot's map, whose blobs need not be sent.
        path: the file.

    Raises:
        CentreRefusedError: the centre cannot make it.
        Unreachable: the link broke. What arrived is kept.
        MapCorruptError: what arrived is not sound.
    """
    artifact = link.ask("POST", request, wanted)
    if artifact["state"] == "failed":
        raise MapCorruptError(
            f"the centre cannot make revision {wanted['ref']}: {artifact['error']}"
        )
    if artifact["state"] != "ready":
        return False
    sent = link.ask("GET", f"/v1/artifacts/{artifact['id']}/manifest")
    manifest = decode_manifest(msgspec.json.encode(sent))
    _log.info("fetching revision %s", wanted["ref"])
    own = split(live) if live.exists() else None

    def part_of(part: PartHash) -> bytes | None:
        body = state.arrived(part)
        return next(own.parts([part]), None) if body is None and own is not None else body

    parts = f"/v1/artifacts/{artifact['id']}/parts"
    _receive(link, state, parts, list(manifest.hashes()), own)
    blobs = [blob for _, _, named in blobs_named(manifest, part_of) for blob in named]
    _receive(link, state, parts, blobs, own)
    path.unlink(missing_ok=True)
    join(manifest, part_of, path)
    problems = check_file(path).problems
    if problems:
        path.unlink()
        raise MapCorruptError(
            f"the download has {len(problems)} faults ({problems[0]}); it is fetched again"
        )
    state.share([*manifest.hashes(), *blobs])
    state.remember(base=encode_manifest(manifest).decode())
    state.clear_arrived()
    return True


def _receive(
    link: CentreLink, state: AgentState, path: str, parts: list[PartHash], own: Split | None
) -> None:
    here = state.arrived_hashes()
    known = own or ()
    wanted = [part for part in dict.fromkeys(parts) if part not in here and part not in known]
    for at in range(0, len(wanted), _REQUESTED_AT_ONCE):
        arrived: list[tuple[PartHash, bytes]] = []
        size = 0
        try:
            for part, body in link.receive(path, wanted[at : at + _REQUESTED_AT_ONCE]):
                arrived.append((part, body))
                size += len(body)
                if size >= _KEEP_BYTES:
                    state.arrive(arrived)
                    arrived, size = [], 0
        finally:
            state.arrive(arrived)
