"""Maps that stay open for the next drive: opening a large one takes seconds."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

from engram.maps import Map
from engram.maps.frame_reader import DEFAULT_CACHE_BYTES


class KeptMaps:
    """The map files requested last, as they were when they were opened; one worker's.

    Args:
        files: how many are kept, each in all the revisions that were asked for.
        cache_bytes: how much memory the landmarks of each map may take.
    """

    def __init__(self, files: int, cache_bytes: int = DEFAULT_CACHE_BYTES) -> None:
        self._most = files
        self._cache_bytes = cache_bytes
        self._files: OrderedDict[tuple[Path, int], dict[int | None, Map]] = OrderedDict()

    def open(self, path: Path, at: int | None = None) -> Map:
        """A map, of a revision if one is given. It is closed here, once others are requested.

        Raises:
            MapError: it cannot be read.
        """
        # A map that was made anew stands in another file of the same name.
        file = path, path.stat().st_ino
        maps = self._files.setdefault(file, {})
        self._files.move_to_end(file)
        while len(self._files) > self._most:
            _close(self._files.popitem(last=False)[1])
        if at not in maps:
            maps[at] = Map.open(path, at=at, cache_bytes=self._cache_bytes)
        return maps[at]

    def close(self) -> None:
        """Closes them all."""
        for maps in self._files.values():
            _close(maps)
        self._files.clear()


def _close(maps: dict[int | None, Map]) -> None:
    for opened in maps.values():
        opened.close()
