"""The words of nodes, kept beside them."""

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.maps.maps import begin, session, write_drive

from engram.errors import InputError, MapCorruptError
from engram.graph.model import NodeId
from engram.maps.attempts import decode_words, encode_words
from engram.maps.map import Map
from engram.maps.map_files import check_file

ONE, OTHER = b"1" * 16, b"2" * 16
RISING = st.sets(st.integers(0, 65535), max_size=600).map(sorted)


@given(RISING)
def test_words_come_back_as_they_were_put(words: list[int]) -> None:
    assert decode_words(encode_words(np.array(words, np.int32))).tolist() == words


@pytest.mark.parametrize("words", [[3, 3], [4, 2], [-1], [65536]])
def test_what_cannot_be_words_is_refused(words: list[int]) -> None:
    with pytest.raises(InputError):
        encode_words(np.array(words))


@given(st.binary(max_size=20))
def test_any_bytes_are_words_or_damage(body: bytes) -> None:
    try:
        words = decode_words(body)
    except MapCorruptError:
        return
    assert encode_words(words) == body


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.engram"


def words_of(count: int) -> np.ndarray:
    return np.arange(count, dtype=np.int32)


def map_with_words(path: Path) -> list[NodeId]:
    """Three nodes, the first two with words."""
    with Map.create(path) as store:
        writer = begin(store, session("robot-1"))
        nodes = [node.id for node in write_drive(writer, 3).nodes]
        for count, node in enumerate(nodes[:2]):
            writer.add_words(node, ONE, words_of(count))
        writer.commit()
    return nodes


def test_a_session_brings_the_words_of_its_nodes(path: Path) -> None:
    nodes = map_with_words(path)
    with Map.open(path) as store:
        kept = store.words(ONE, nodes)
        assert {node: words.tolist() for node, words in kept.items()} == {
            nodes[0]: [],
            nodes[1]: [0],
        }
        assert store.words(OTHER, nodes) == {}
    assert check_file(path).problems == ()


def test_another_vocabulary_takes_the_place_of_the_first(path: Path) -> None:
    nodes = map_with_words(path)
    with Map.open(path, writes=True) as store:
        store.put_words(OTHER, {nodes[1]: words_of(5), nodes[2]: words_of(7)})
        assert {len(words) for words in store.words(OTHER, nodes).values()} == {5, 7}
        assert list(store.words(ONE, nodes)) == [nodes[0]]


def test_words_change_neither_history_nor_content(path: Path) -> None:
    nodes = map_with_words(path)
    with Map.open(path, writes=True) as store:
        before = store.content_hash(), store.revision
        store.put_words(OTHER, {nodes[2]: words_of(7)})
        assert (store.content_hash(), store.revision) == before


def test_damaged_words_are_as_if_they_were_missing_and_check_names_them(path: Path) -> None:
    nodes = map_with_words(path)
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE words SET body = x'0102030405' WHERE length(body) = 2")
    connection.close()
    with Map.open(path) as store:
        assert list(store.words(ONE, nodes)) == [nodes[0]]
    problems = check_file(path).problems
    assert [problem.table for problem in problems] == ["words"]
    assert str(nodes[1]) in problems[0].record


def test_words_of_an_abandoned_session_go_with_it(path: Path) -> None:
    with Map.create(path) as store:
        writer = begin(store, session("robot-1"))
        for node in write_drive(writer, 2).nodes:
            writer.add_words(node.id, ONE, words_of(3))
        writer.checkpoint()
        writer.abandon()
        store.clean()
        second = begin(store, session("robot-2"))  # its nodes get the same keys
        nodes = [node.id for node in write_drive(second, 2).nodes]
        second.commit()
        assert store.words(ONE, nodes) == {}
    assert check_file(path).problems == ()


def test_only_nodes_of_the_map_have_words(path: Path) -> None:
    map_with_words(path)
    with Map.open(path, writes=True) as store, pytest.raises(InputError, match="not in the"):
        store.put_words(ONE, {NodeId(session("x").id): words_of(1)})
