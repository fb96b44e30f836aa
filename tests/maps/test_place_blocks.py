"""Blocks of places, kept beside the words from which they follow."""

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from tests.maps.maps import begin, session, write_drive

from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.place_blocks import BODY, NUMBERS, PLACES_PER_BLOCK, UNREADABLE

ONE, OTHER, NAME, ROWS = b"1" * 16, b"2" * 16, "fabmap 12345678", 2


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "a.engram"
    with Map.create(path) as store:
        writer = begin(store, session("robot-1"))
        write_drive(writer, 3)
        writer.commit()
    return path


def parts(seed: int, unreadable: tuple[int, ...] = ()) -> dict[str, bytes]:
    numbers = np.random.default_rng(seed).normal(size=(ROWS, PLACES_PER_BLOCK))
    return {
        NUMBERS: numbers.tobytes(),
        UNREADABLE: np.array(unreadable, "<i4").tobytes(),
        BODY: bytes([seed]) * 9,
    }


def put(path: Path, number: int, vocabulary: bytes = ONE, **content: dict[str, bytes]) -> None:
    given = content.get("given") or parts(number)
    with Map.open(path, writes=True) as store:
        store.put_place_block(vocabulary, NAME, number, given)


def stored(path: Path, vocabulary: bytes = ONE) -> tuple[int, set[int], list[bytes | None]]:
    """Number of places, those that are unreadable, and the bodies of three blocks."""
    with Map.open(path) as store:
        blocks = store.place_blocks(vocabulary, NAME)
        numbers, unreadable = blocks.read(ROWS)
        return numbers.shape[1], unreadable, [blocks.body(number) for number in range(3)]


def change(path: Path, part: str, number: int) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute(
            "UPDATE place_blocks SET content = CAST(x'07' || content AS BLOB) "
            "WHERE part = ? AND block = ?",
            [part, number],
        )
    connection.close()


def test_blocks_come_back_as_they_were_put_and_change_no_content(path: Path) -> None:
    with Map.open(path) as store:
        before = store.content_hash(), store.revision
    put(path, 0, given=parts(0, (4, 8000)))
    put(path, 1, given=parts(1, (0,)))
    places, unreadable, bodies = stored(path)
    assert places == 2 * PLACES_PER_BLOCK
    assert unreadable == {4, 8000, PLACES_PER_BLOCK}
    assert bodies == [bytes(9), b"\1" * 9, None]
    with Map.open(path) as store:
        assert (store.content_hash(), store.revision) == before
        numbers, _ = store.place_blocks(ONE, NAME).read(ROWS)
        expected = np.frombuffer(parts(1)[NUMBERS]).reshape(ROWS, -1)
        assert np.array_equal(numbers[:, PLACES_PER_BLOCK:], expected)
        assert store.place_blocks(ONE, "another").read(ROWS)[0].shape == (ROWS, 0)
    assert check_file(path).problems == ()


def test_blocks_after_a_missing_one_are_not_used(path: Path) -> None:
    put(path, 0)
    put(path, 2)
    assert stored(path)[0] == PLACES_PER_BLOCK


def test_blocks_by_another_vocabulary_replace_those_of_the_first(path: Path) -> None:
    put(path, 0)
    put(path, 0, OTHER)
    assert stored(path)[0] == 0
    assert stored(path, OTHER)[0] == PLACES_PER_BLOCK


@pytest.mark.parametrize(("part", "places"), [(NUMBERS, 0), (UNREADABLE, 0), (BODY, 1)])
def test_damage_costs_places_and_check_names_it(path: Path, part: str, places: int) -> None:
    put(path, 0)
    change(path, part, 0)
    assert stored(path)[0] == places * PLACES_PER_BLOCK
    assert (stored(path)[2][0] is None) == (part == BODY)
    assert [problem.table for problem in check_file(path).problems] == ["place_blocks"]


def test_keys_that_may_be_used_again_are_not_settled(path: Path) -> None:
    with Map.open(path, writes=True) as store:
        assert store.settled_nodes == 3
        writer = begin(store, session("robot-2"))
        write_drive(writer, 2)
        writer.checkpoint()
        assert store.settled_nodes == 3
        writer.abandon()
        assert store.settled_nodes == 3
    with Map.open(path, writes=True) as store:
        store.clean()
        writer = begin(store, session("robot-2"))
        write_drive(writer, 2)
        writer.commit()
        settled = store.settled_nodes
    with sqlite3.connect(path) as connection:
        (newest,) = connection.execute("SELECT max(key) FROM nodes").fetchone()
    connection.close()
    assert settled == newest > 3
