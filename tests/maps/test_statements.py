"""Statements are compiled once a process, not once a map."""

from pathlib import Path

from sqlalchemy.util import LRUCache

from engram import sqlite
from engram.maps.map import Map

from .maps import begin, session, write_drive


def written_and_read(path: Path) -> None:
    with Map.create(path) as store:
        writer = begin(store, session())
        write_drive(writer, 1)
        writer.commit()
    with Map.open(path) as store:
        store.load()
        store.content_hash()


def test_a_second_map_compiles_nothing_anew(tmp_path: Path, monkeypatch) -> None:
    """A process that opens many small maps would spend half of its time on that."""
    compiled: LRUCache = LRUCache(500)
    monkeypatch.setattr(sqlite, "_COMPILED", compiled)
    written_and_read(tmp_path / "first.engram")
    known = set(compiled)
    assert known
    written_and_read(tmp_path / "second.engram")
    assert set(compiled) == known
