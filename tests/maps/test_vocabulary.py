"""Vocabularies in a map: the newest that a revision sees."""

import sqlite3
from pathlib import Path

import pytest

from engram.errors import MapCorruptError
from engram.maps.map import Map
from engram.maps.map_files import check_file


def put(path: Path, body: bytes) -> int:
    with Map.open(path, writes=True) as store:
        revision = store.put_vocabulary(body, author="a", message="words", configuration={"k": 1})
        assert store.vocabulary == body
        return revision.number


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "a.engram"
    Map.create(path).close()
    return path


def test_a_new_map_has_none(path: Path) -> None:
    with Map.open(path) as store:
        assert store.vocabulary is None


def test_the_newest_counts_and_older_revisions_keep_theirs(path: Path) -> None:
    first, second = put(path, b"first"), put(path, b"second")
    assert (first, second) == (1, 2)
    for at, expected in ((0, None), (1, b"first"), (2, b"second"), (None, b"second")):
        with Map.open(path, at=at) as store:
            assert store.vocabulary == expected
    with Map.open(path) as store:
        assert [one.message for one in store.log()] == ["words", "words"]
    assert check_file(path).problems == ()


def test_damage_is_told(path: Path) -> None:
    put(path, b"sound")
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE vocabularies SET body = x'00'")
    with Map.open(path) as store, pytest.raises(MapCorruptError):
        _ = store.vocabulary
    assert len(check_file(path).problems) >= 1
