"""Synthetic cities: sound maps in which a robot finds its way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from engram.frontend.frame import BRIEF
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.places.recognisers import PLACES_PER_BLOCK, FabMap
from engram.places.vocabulary import default_vocabulary
from engram.places.words import NodeWords, PlaceBook
from engram_lab.studies.scale import (
    City,
    Figures,
    ask,
    download_in,
    drive_in,
    look_back,
    lost_in,
    map_in,
    merge_in,
    table,
    write_in,
)


def test_a_city_is_a_sound_map_that_localises(tmp_path: Path) -> None:
    city, path = City(3, length=26), tmp_path / "city.engram"
    city.write(path)

    assert check_file(path).problems == ()
    with Map.open(path) as opened:
        info = opened.info()
        assert (info.nodes, info.sessions, info.revision) == (390, 15, 3)
        assert info.edges / info.nodes > 7
        assert city.node(1, 2, 20).id in {node.id for node in opened.load().nodes}
    figures = drive_in(path, city)
    assert figures["localised (%)"] > 90
    before = path.read_bytes()
    assert lost_in(path, city)["lost: frames until found"] <= 3
    assert map_in(path, city)["mapping: saved nodes"] == 3
    assert all(seconds >= 0 for seconds in write_in(path, city).values())
    assert {"info (s)", "show NODE (s)", "goal (s)", "plot (s)"} < ask(path, city).keys()
    assert {"diff (s)", "check --since (s)", "revert (s)"} < look_back(path, city).keys()
    assert {"merge, 50 nodes, beyond the replay (s)"} < merge_in(path, city).keys()
    assert {"download 5 MB of 2,000 nodes (s)"} < download_in(path, city).keys()
    assert path.read_bytes() == before


@pytest.mark.long
def test_a_lost_robot_finds_the_same_places_by_stored_blocks(tmp_path: Path) -> None:
    city, path = City(4, length=450), tmp_path / "city.engram"
    city.write(path)
    vocabulary = default_vocabulary(BRIEF)

    def places() -> tuple[int, np.ndarray, set[int]]:
        with Map.open(path) as opened:
            words = NodeWords.of_map(opened, vocabulary)
            book = PlaceBook(opened.read_graph(), words, FabMap)
            book.learn_new_nodes()
            query = words.of_node(city.node(1, 2, 20).id)
            assert query is not None
            stored = opened.place_blocks(words.hash, FabMap(vocabulary).stored_as).count
            return stored, book.compare(query).evidence, book.unreadable

    blocks, whole, _ = places()
    assert blocks == 0
    with Map.open(path, writes=True) as opened:
        NodeWords.of_map(opened, vocabulary).keep_missing()
    blocks, by_blocks, unreadable = places()
    assert blocks == city.nodes // PLACES_PER_BLOCK == 1
    assert np.array_equal(whole, by_blocks)
    assert not unreadable
    assert check_file(path).problems == ()

    with Map.open(path, writes=True) as opened:
        opened.revert("2", author="test", message="")
    blocks, by_blocks, unreadable = places()
    assert blocks == 1
    assert np.array_equal(whole[:PLACES_PER_BLOCK], by_blocks[:PLACES_PER_BLOCK])
    assert unreadable == set(range(2250, 4500))


def test_the_table_has_a_column_a_city() -> None:
    found = [Figures(5000, {"a": 1.0}), Figures(20000, {"a": 2.0, "b": 0.25})]

    assert table(found).splitlines() == [
        "| | 5,000 | 20,000 |",
        "| --- | --- | --- |",
        "| a | 1 | 2 |",
        "| b |  | 0.25 |",
    ]
