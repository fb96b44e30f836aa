"""Vocabularies in a map: the newest that a revision sees."""

import sqlite3
from pathlib import Path

import pytest

from engram.errors import MapCorruptError
from engram.maps import MapStore


def put(path: Path, body: bytes) -> int:
    with MapStore.open_for_writing(path) as store:
        revision = store.put_vocabulary(body, author="a", message="words", configuration={"k": 1})
        assert store.vocabulary() == body
        return revision.number


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "a.engram"
    MapStore.create(path).close()
    return path


def test_a_new_map_has_none(path: Path) -> None:
    with MapStore.open(path) as store:
        assert store.vocabulary() is None


def test_the_newest_counts_and_older_revisions_keep_theirs(path: Path) -> None:
    first, second = put(path, b"first"), put(path, b"second")
    assert (first, second) == (1, 2)
    for at, expected in ((0, None), (1, b"first"), (2, b"second"), (None, b"second")):
        with MapStore.open(path, at=at) as store:
            assert store.vocabulary() == expected
    with MapStore.open(path) as store:
        assert [one.message for one in store.log()] == ["words", "words"]
    assert MapStore.check(path).problems == ()


def test_damage_is_told(path: Path) -> None:
    put(path, b"sound")
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE vocabularies SET body = x'00'")
    with MapStore.open(path) as store, pytest.raises(MapCorruptError):
        store.vocabulary()
    assert len(MapStore.check(path).problems) >= 1
