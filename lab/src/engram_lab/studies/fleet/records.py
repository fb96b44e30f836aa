"""What is kept of merges, downloads and drives in the field, next to the maps they made."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from engram.config import to_dict
from engram.measures import Drive
from engram_lab.studies.building import write_json
from engram_lab.studies.in_force import Values


@dataclass(frozen=True, slots=True)
class MergeRecord:
    """One merge into a centre.

    Attributes:
        name: of the map handed in.
        nodes: of the centre afterwards.
        components: connected components of the centre afterwards.
        taken, omitted: nodes.
        frames: nodes that were replayed.
        attempts, proposed, lookups: match attempts, those of them at proposed nodes, and nodes for
            which the relocaliser was asked.
        seconds: wall time.
        in_force: what the centre keeps of how it was made.
    """

    name: str
    nodes: int
    components: int
    taken: int
    omitted: int
    frames: int
    attempts: int
    proposed: int
    lookups: int
    seconds: float
    in_force: Values = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DownloadRecord:
    """One download for a foray.

    Attributes:
        policy: key of `SELECTIONS`; another than was asked for where nothing was driven at that
            hour.
        start_h: hour of day that it was made for; None if it is not known.
        nodes, of_nodes: sent, and of the centre.
        united: sent, together with what the robot itself had saved and the centre knows.
        size_bytes, of_bytes: of the file, and of the centre's.
        in_force: what the file keeps of how it was made.
    """

    policy: str
    start_h: float | None
    nodes: int
    of_nodes: int
    united: int
    size_bytes: int
    of_bytes: int
    in_force: Values = field(default_factory=dict)


def write_record(path: Path, record: Any) -> None:
    """Writes a dataclass."""
    write_json(path, to_dict(record))


def read_json(path: Path) -> Any:
    """What `write_record` wrote, as plain values."""
    return json.loads(path.read_text(encoding="utf-8"))


def read_merge(path: Path) -> MergeRecord | None:
    """What a merge came to; None if it is still to be done."""
    return MergeRecord(**read_json(path)) if path.exists() else None


def read_download(path: Path) -> DownloadRecord | None:
    """What a download came to; None if it is still to be done."""
    return DownloadRecord(**read_json(path)) if path.exists() else None


def write_drive(path: Path, drive: Drive, frame_ms: list[float]) -> None:
    """How a drive went in the field: in one step."""
    draft = path.with_name(f".{path.name}.part.npz")
    np.savez_compressed(draft, step_m=drive.step_m, matched=drive.matched, frame_ms=frame_ms)
    draft.replace(path)


def read_drive(path: Path) -> tuple[Drive, float] | None:
    """How a drive went in the field, and mean ms of localising a frame; None if it did not yet."""
    if not path.exists():
        return None
    with np.load(path) as kept:
        return Drive(kept["step_m"], kept["matched"]), float(kept["frame_ms"].mean())
