"""Opens a map by its path; an empty one is made on request."""

from __future__ import annotations

from pathlib import Path

from engram.files import map_path
from engram.keywords import keywords
from engram.maps.map import Map


@keywords()
def open_map(path: Path | str, at: int | str | None = None, create: bool = False) -> Map:
    """Opens a map for localising, writing or reading.

    Until it is written to, the map stays as it is now, whatever others commit: open it again to see
    later revisions. A robot stays with the map that it began in.

    Args:
        path: NAME.engram.
        at: number or name of a revision (7, a tag, "head~2"), to see the map as it was then; None
            for the newest.
        create: create an empty map if the file does not exist and no revision is named.

    Raises:
        NotAMapError: the file does not exist, or is not a map.
        FormatVersionError: a newer Engram wrote it.
        MapCorruptError: it is too damaged to read.
        RevisionError: there is no such revision.
        InputError: a map is to be created, and its folder does not exist.
        ConfigError: a keyword is unknown.
    """
    if create and at is None and not map_path(path).exists():
        Map.create(path).close()
    return Map.open(path, at=at)
