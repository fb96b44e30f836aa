"""Robots' maps as they were handed in, kept next to the fleet map for dreaming."""

from __future__ import annotations

from pathlib import Path

from engram.files import draft_folder
from engram.maps import Map, copy_map, publish_map


def hand_ins_folder(centre: Path) -> Path:
    """The folder of a fleet map's hand-ins."""
    return centre.with_name(f"{centre.name}.handed")


def hand_ins_of(centre: Path) -> list[Path]:
    """The kept hand-ins, in the order in which they came."""
    return sorted(hand_ins_folder(centre).glob("*.engram"))


def keep_hand_in(centre: Path, robot: Path) -> Path:
    """Keeps a copy of a robot's map; one of the same content is kept once.

    Args:
        centre: the fleet map.
        robot: the map that was handed in.

    Returns:
        The kept copy, NUMBER-CONTENT.engram.

    Raises:
        MapError: it cannot be read, or not be written there.
    """
    with Map.open(robot) as store:
        content = store.content_hash()
    known = hand_ins_of(centre)
    for path in known:
        if path.stem.endswith(content):
            return path
    folder = hand_ins_folder(centre)
    folder.mkdir(exist_ok=True)
    last = max((int(path.stem.split("-")[0]) for path in known), default=0)
    kept = folder / f"{last + 1:06d}-{content}.engram"
    with draft_folder(kept) as drafts:
        copy_map(robot, drafts / kept.name)
        publish_map(drafts / kept.name, kept)
    return kept
