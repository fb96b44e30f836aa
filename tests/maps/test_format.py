"""A map of every format opens for ever; and the page that describes the format is right."""

from __future__ import annotations

import shutil
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
from tests.worlds import attempts_of

from engram.errors import IncompatibleError
from engram.frontend import BRIEF, TEBLID
from engram.geometry import SE3
from engram.graph.model import EdgeKind, NodeId, Omission
from engram.maps import Map, SessionState, check_file
from engram.maps.schema import FORMAT_VERSION

from .maps import begin, node, session

DATA = Path(__file__).parent / "data"
HASH = bytes(range(16))
PAGE = Path(__file__).parents[2] / "docs" / "format.md"


@pytest.fixture
def old(tmp_path):
    """Format 1: two committed sessions of 4 and 3 nodes, and one of 2 that was interrupted."""
    return shutil.copy(DATA / "format-1.engram", tmp_path / "old.engram")


def test_format_1_reads_as_it_was_written(old):
    with Map.open(old) as store:
        contents = store.load()
        assert contents.sessions == (session("robot-1"), session("robot-2"))
        expected = [node(session("robot-1"), index) for index in range(4)]
        expected += [node(session("robot-2"), index) for index in range(3)]
        assert contents.nodes == tuple(expected)
        assert len(contents.path_entries) == 7
        made = attempts_of(contents, session("robot-2").id)
        assert [(one.iteration, one.rank) for one in made] == [
            (iteration, rank) for iteration in (1, 2) for rank in range(3)
        ]
        for one in contents.nodes:
            frame = store.frames.frame(one.id)
            assert len(frame.landmarks) == 20
            assert frame.descriptor == BRIEF
            assert store.frames.thumbnail(one.id).shape == (30, 40)
        assert store.statistics() == {"basin": {"g": [0.94, 0.7, 0.4]}}
        assert [revision.message for revision in store.log()] == ["the first", "the second"]
        assert [one.session for one in store.interrupted()] == [session("robot-3")]


@pytest.mark.parametrize(
    ("at", "expected"),
    [(1, "fdd08fe8b0d456052e442cf7aa78c177"), (2, "6b2b5e50d8e8c3be77655846e443c042")],
)
def test_format_1_keeps_its_content_hash(old, at, expected):
    with Map.open(old, at=at) as store:
        assert store.content_hash() == expected


def test_format_1_supersedes_edges(old):
    with Map.open(old, at=1) as before, Map.open(old, at=2) as after:
        (was,) = (e for e in before.load().edges if e.kind is EdgeKind.PROXIMITY)
        (now,) = (e for e in after.load().edges if e.kind is EdgeKind.PROXIMITY)
    assert (was.a, was.b) == (now.a, now.b)
    assert np.abs(was.a_from_b.matrix() - now.a_from_b.matrix()).max() > 0.1


def test_format_1_is_sound_and_can_be_written_on(old):
    assert check_file(old).problems == ()
    with Map.open(old, writes=True) as store:
        with pytest.raises(IncompatibleError):
            begin(store, session("robot-4"), descriptor=TEBLID)
        assert store.session_state(session("robot-1").id) is SessionState.COMMITTED
        assert store.seal(session("robot-3").id).contents["nodes"] == 2
        begin(store, session("robot-4")).commit()
        assert store.revision == 4
    assert check_file(old).problems == ()


def test_the_page_on_the_format_is_of_this_format_and_includes_its_tables():
    page = PAGE.read_text()
    assert f"format {FORMAT_VERSION}" in page
    assert "generated/tables.md" in page


@pytest.mark.parametrize("version", range(1, FORMAT_VERSION))
def test_older_maps_become_of_the_newest_format_when_they_are_written_on(tmp_path, version):
    path = shutil.copy(DATA / f"format-{version}.engram", tmp_path / "old.engram")
    with Map.open(path) as store:
        assert store.format_version == version
        before, contents = store.content_hash(), store.load()
    with Map.open(path, writes=True) as store:
        assert store.format_version == FORMAT_VERSION
        assert store.content_hash() == before
        omitted = Omission(
            node(session("robot-9"), 0).id, contents.nodes[0].id, SE3.identity(), HASH
        )
        with store.begin_revision(author="tests", message="", configuration={}) as writer:
            writer.add_omission(omitted)
            writer.commit()
        assert store.landmark_hashes[omitted.omitted] == HASH
        assert store.content_hash() != before
    assert check_file(path).problems == ()


@pytest.fixture
def second(tmp_path):
    """Format 2: two drives, one taken back and mapped again; a tag; the words of one node."""
    return shutil.copy(DATA / "format-2.engram", tmp_path / "second.engram")


def test_format_2_reads_as_it_was_written(second):
    drives = (session("robot-1"), session("robot-2"))
    counts = {1: (3, 0), 2: (3, 3), 3: (3, 0), 4: (3, 4)}
    for at, (first, other) in counts.items():
        with Map.open(second, at=at) as store:
            expected = [node(drives[0], index) for index in range(first)]
            expected += [node(drives[1], index) for index in range(other)]
            assert set(store.load().nodes) == set(expected)
            assert len(store.load().path_entries) == len(expected)
    with Map.open(second, at="both") as store:
        assert store.revision == 2
        assert store.tags()["both"].message == "two drives"
        (found,) = store.words(bytes(16)).items()
        assert found[0] == node(drives[1], 0).id
        np.testing.assert_array_equal(found[1], [1, 5, 9])
    assert check_file(second).problems == ()


@pytest.mark.parametrize(
    ("at", "expected"),
    [(2, "c9d498a5dce9f96aee4ff70849091cb5"), (4, "9f56160275237e470163fb0528ea3502")],
)
def test_format_2_keeps_its_content_hash(second, at, expected):
    with Map.open(second, at=at) as store:
        assert store.content_hash() == expected


@pytest.fixture
def third(tmp_path):
    """Format 3: a drive of three nodes, and a fourth that was omitted."""
    return shutil.copy(DATA / "format-3.engram", tmp_path / "third.engram")


def test_format_3_reads_as_it_was_written(third):
    with Map.open(third) as store:
        (omission,) = store.omissions.values()
        assert omission.omitted == NodeId(UUID(int=3))
        assert omission.node == node(session("robot-1"), 1).id
        assert omission.landmark_hash == HASH
        assert set(store.landmark_hashes) == {one.id for one in store.load().nodes} | {
            omission.omitted
        }
    with Map.open(third, at=1) as store:
        assert len(store.landmark_hashes) == 3
    assert check_file(third).problems == ()


@pytest.mark.parametrize(
    ("at", "expected"),
    [(1, "34f49b799af7925db24ff73b39a16a21"), (2, "5faf38a7d236dd3b61d25bc49e553f96")],
)
def test_format_3_keeps_its_content_hash(third, at, expected):
    with Map.open(third, at=at) as store:
        assert store.content_hash() == expected


def test_format_4_reads_as_it_was_written(tmp_path):
    path = shutil.copy(DATA / "format-4.engram", tmp_path / "fourth.engram")
    with Map.open(path) as store:
        (shown,) = store.sessions.values()
        assert (shown.robot, shown.zone) == ("robot-2", "Europe/London")
        assert store.content_hash() == "ae59546e3a9c0172b79e5526ea6e6a71"
    with Map.open(path, at=1) as store:
        (shown,) = store.sessions.values()
        assert (shown.robot, shown.zone) == ("robot-1", "Europe/Prague")
    assert check_file(path).problems == ()


def test_format_5_reads_as_it_was_written(tmp_path):
    path = shutil.copy(DATA / "format-5.engram", tmp_path / "fifth.engram")
    with Map.open(path) as store:
        (removal,) = store.removals
        assert removal.reason == "a test"
        assert len(store.load().edges) == 1
        assert store.info().edges == 1
        assert store.anchors[0].x_m == 1.0
        assert store.anchors[0].z_m is None
        assert store.goals["dock"].node == node(session("robot-1"), 1).id
        assert len(store.placements) == 3
    with Map.open(path, at=1) as store:
        assert len(store.load().edges) == 2
        assert store.removals == ()
    assert check_file(path).problems == ()


def test_format_6_reads_as_it_was_written(tmp_path):
    path = shutil.copy(DATA / "format-6.engram", tmp_path / "sixth.engram")
    with Map.open(path) as store:
        assert list(store.tags()) == ["best"]
        assert store.revision == 1
    assert check_file(path).problems == ()
