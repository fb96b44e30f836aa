"""A map keeps the words of its nodes: opening it for lost robots reads no landmarks."""

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from lab.tests.evaluation.campaigns import write_campaign
from tests.builders import World, drive, localise_simulated, map_simulated

from engram.errors import IncompatibleError, InputError
from engram.frontend.frame import BRIEF
from engram.maps.map import Map, open_map
from engram.monitor import Monitor
from engram.places.vocabulary import TrainingConfig, default_vocabulary, encode_vocabulary
from engram.places.words import NodeWords, vocabulary_of
from engram.robot.localisers import relocaliser_in
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.vocabularies import train_map_vocabulary, use_vocabulary
from engram.sequences.opening import open_drive
from engram_lab.teblid import TEBLID

ROAD = World(length_m=60.0, seed=11)
VOCABULARY = default_vocabulary(BRIEF)
LIVE = drive(ROAD, 20 + np.arange(0, 3, 0.5), start_ns=2_000_000_000_000, seed=1)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "road.engram"
    map_simulated(path, drive(ROAD, np.arange(0, 40, 1.0)))
    return path


def fill(path: Path) -> int:
    with Map.open(path, writes=True) as store:
        return NodeWords.of_map(store, VOCABULARY).keep_missing()


def count_nodes(path: Path) -> int:
    with Map.open(path) as store:
        return store.info().nodes


def landmarks_read(path: Path, monkeypatch: pytest.MonkeyPatch) -> int:
    """How many frames a relocaliser reads before it looks up the first frame."""
    read = []
    with open_map(path) as opened:
        reader = opened.frames.frame
        monkeypatch.setattr(opened.frames, "frame", lambda node: read.append(node) or reader(node))
        relocaliser_in(opened, "fabmap", BRIEF).book.learn_new_nodes()
    return len(read)


def test_words_are_worked_out_once(path: Path) -> None:
    assert fill(path) == count_nodes(path) > 20
    assert fill(path) == 0


def test_they_are_those_of_the_landmarks(path: Path) -> None:
    fill(path)
    with Map.open(path) as store:
        nodes = store.load().nodes
        kept = NodeWords.of_map(store, VOCABULARY).stored([node.id for node in nodes])
        for node in nodes:
            frame = store.frames.frame(node.id)
            assert (
                kept[node.id].tolist()
                == VOCABULARY.words_of(frame.landmarks.descriptors, frame.descriptor).tolist()
            )


def test_opening_for_a_lost_robot_reads_no_landmarks(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert landmarks_read(path, monkeypatch) > 0
    fill(path)
    assert landmarks_read(path, monkeypatch) == 0


@pytest.mark.parametrize("filled", [True, False])
def test_one_damaged_node_does_not_stop_it(path: Path, filled: bool) -> None:
    if filled:
        fill(path)
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE frames SET landmarks = x'00' WHERE node = 1")
    connection.close()
    found = localise_simulated(path, LIVE, relocaliser="fabmap")
    assert all(one.node is not None for one in found)


def test_mapping_keeps_the_words_of_what_it_saves_and_of_what_was_there(
    path: Path, tmp_path: Path
) -> None:
    before = count_nodes(path)
    write_campaign(tmp_path / "elsewhere", looks=(1,))
    (log,) = (tmp_path / "elsewhere").glob("*.framelog")
    map_drive(path, open_drive(log), Settings(), RobotOptions())
    with Map.open(path) as store:
        nodes = {node.id for node in store.load().nodes}
        assert len(nodes) >= before + 10
        assert NodeWords.of_map(store, VOCABULARY).stored(list(nodes)).keys() == nodes


def test_training_and_taking_a_vocabulary_fill_in_words(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.engram"
    map_simulated(other, drive(ROAD, np.arange(0, 10, 1.0)), name="r2")
    stages: list[str] = []

    class Heard(Monitor):
        def stage(self, what: str, total: int):
            stages.append(what)
            return super().stage(what, total)

    config = TrainingConfig(words=50, iterations=2)
    trained = train_map_vocabulary(path, [], config, author="a", monitor=Heard())
    taken = use_vocabulary(other, path, author="a", monitor=Heard())
    assert trained.hash == taken.hash
    assert stages == ["read", "cluster", "quantise", "relate", "words", "words"]
    for one in (path, other):
        with Map.open(one) as opened:
            assert opened.vocabulary is not None
            nodes = [node.id for node in opened.load().nodes]
            stored = NodeWords.of_map(opened, vocabulary_of(opened)).stored(nodes)
            assert len(stored) == len(nodes) == count_nodes(one)
    again = use_vocabulary(other, path, author="a", monitor=Heard())
    assert again.revision is None


def test_a_vocabulary_that_cannot_be_used_is_refused(path: Path, tmp_path: Path) -> None:
    teblid = tmp_path / "teblid.safetensors"
    teblid.write_bytes(encode_vocabulary(default_vocabulary(TEBLID)))
    with pytest.raises(IncompatibleError, match="teblid"):
        use_vocabulary(path, teblid, author="a")
    with pytest.raises(InputError, match="no vocabulary of its own"):
        use_vocabulary(path, path, author="a")
    junk = tmp_path / "junk"
    junk.write_bytes(b"junk")
    with pytest.raises(InputError, match="junk"):
        use_vocabulary(path, junk, author="a")
    with pytest.raises(InputError, match="absent"):
        use_vocabulary(path, tmp_path / "absent", author="a")


def test_lost_robots_are_found_by_kept_words_as_by_fresh_ones(path: Path) -> None:
    made = localise_simulated(path, LIVE, relocaliser="fabmap")
    fill(path)
    again = localise_simulated(path, LIVE, relocaliser="fabmap")
    assert [one.node for one in made] == [one.node for one in again]
