"""Opens a map by its path; an empty one is made where asked."""

from __future__ import annotations

from pathlib import Path

from engram.maps.map import Map
from engram.maps.sqlite import map_path


def open_map(path: Path | str, at: int | str | None = None, create: bool = False) -> Map:
    """Opens a map for localising, writing or reading.

    Until it is written to, the map stays as it is now, whatever others commit: open it anew to see
    later revisions. A robot stays with the map that it began in.

    Args:
        path: NAME.engram.
        at: number or tag of a revision, to see the map as it was then; None for the newest.
        create: create an empty map if the file does not exist and no revision is named.

    Raises:
        MapError: the file is not a map, of a newer format, or damaged.
        RevisionError: there is no such revision.
    """
    if create and at is None and not map_path(path).exists():
        Map.create(path).close()
    return Map.open(path, at=at)
