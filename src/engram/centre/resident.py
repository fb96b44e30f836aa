"""Maps that stay open between requests, each as of its newest revision."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from engram.maps import Map, Revision
from engram.maps.map_reader import MapReader


@dataclass(slots=True)
class _Held:
    store: Map
    inode: int
    users: int = 0
    retired: bool = False


class ResidentMaps:
    """Open maps, for reading, shared by threads.

    What is read of a map once (its log, its nodes) stays until it has a new revision.
    """

    def __init__(self) -> None:
        self._held: dict[Path, _Held] = {}
        self._lock = threading.Lock()

    @contextmanager
    def reading(self, path: Path) -> Iterator[Map]:
        """The map as of its newest revision, which stays as it is within the block.

        Raises:
            MapError: it cannot be read.
        """
        with self._lock:
            held = self._newest(path)
            held.users += 1
        try:
            yield held.store
        finally:
            with self._lock:
                held.users -= 1
                _close_unused(held)

    def close(self) -> None:
        """Closes all maps that have no readers, and the others once their readers finish."""
        with self._lock:
            for held in self._held.values():
                held.retired = True
                _close_unused(held)
            self._held.clear()

    def _newest(self, path: Path) -> _Held:
        held, inode = self._held.get(path), _inode(path)
        if held is not None:
            if held.inode == inode and held.store.resolve(None) == held.store.revision:
                return held
            del self._held[path]
            held.retired = True
            _close_unused(held)
        held = self._held[path] = _Held(Map.open(path), inode)
        return held


def log_of(store: MapReader) -> tuple[Revision, ...]:
    """Its revisions, oldest first, read once."""
    return store.derived(_log)


def _log(store: MapReader) -> tuple[Revision, ...]:
    return tuple(store.log())


def _inode(path: Path) -> int:
    """Inode of a path, by which a restored backup is noticed; 0 if the file is missing."""
    return path.stat().st_ino if path.exists() else 0


def _close_unused(held: _Held) -> None:
    if held.retired and not held.users:
        held.store.close()
