"""A stored map of the format reads as written, others are refused, and the page is right."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from tests.builders import attempts_of

from engram.errors import FormatVersionError, IncompatibleError
from engram.frontend.frame import BRIEF
from engram.graph.model import EdgeKind
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.records import SessionState
from engram.maps.schema import FORMAT_VERSION
from engram.maps.upgrading import upgrade_map
from engram_lab.teblid import TEBLID

from .data.make_map import OMITTED, write_map
from .maps import begin, node, session

STORED = Path(__file__).parent / "data" / f"format-{FORMAT_VERSION}.engram"
PAGE = Path(__file__).parents[2] / "docs" / "format.md"
# Of its revisions: two drives, the second taken back, mapped again, amended, the marks, and a drive
# that was forgotten.
HASHES = {
    1: "0355106e0b85ebde08518eb88d6e9cfd",
    2: "9a4e2b5809647ec0b413e91daf1b7498",
    3: "cabb0d7d3f6c74cd13656c96b60c81ba",
    4: "1100c63d88c24894a9f004f0165ccfe6",
    5: "6fbc5b5fe86a1f42937a00e9f99ed7ed",
    6: "3be46ddd2a07cde630627219d2381b8c",
    7: "b121d98358e40db93b970bfc8ffa4dac",
    8: "36aa00da23eac6d8a3427c2a0f222172",
}


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    """A map with a row of every kind, as it was written when the format came to be."""
    return Path(shutil.copy(STORED, tmp_path / "stored.engram"))


def test_nodes_paths_and_frames_read_as_written(stored: Path) -> None:
    drives = (session("robot-1"), session("robot-2"))
    counts = {1: (4, 0), 2: (4, 3), 3: (4, 0), 4: (4, 5)}
    for at, numbers in counts.items():
        with Map.open(stored, at=at) as store:
            contents = store.load()
            expected = {
                node(drive, index)
                for drive, number in zip(drives, numbers, strict=True)
                for index in range(number)
            }
            assert set(contents.nodes) == expected
            assert len(contents.path_entries) == len(expected)
    with Map.open(stored, at=4) as store:
        made = attempts_of(store.load(), drives[1].id)
        assert [(one.iteration, one.rank) for one in made] == [
            (iteration, rank) for iteration in (1, 2, 3, 4) for rank in range(3)
        ]
        for one in store.load().nodes:
            frame = store.frames.frame(one.id)
            assert len(frame.landmarks) == 20
            assert frame.descriptor == BRIEF
            assert store.frames.thumbnail(one.id).shape == (30, 40)
        assert store.statistics() == {"basin": {"g": [0.94, 0.7, 0.4]}}


def test_a_later_edge_supersedes_an_earlier_one(stored: Path) -> None:
    with Map.open(stored, at=1) as before, Map.open(stored, at=2) as after:
        (was,) = (e for e in before.load().edges if e.kind is EdgeKind.PROXIMITY)
        (now,) = (e for e in after.load().edges if e.kind is EdgeKind.PROXIMITY)
    assert (was.a, was.b) == (now.a, now.b)
    assert np.abs(was.a_from_b.matrix() - now.a_from_b.matrix()).max() > 0.1


def test_tags_words_and_amendments_read_as_written(stored: Path) -> None:
    with Map.open(stored, at="both") as store:
        assert store.revision == 2
        assert store.tags()["both"].message == "two drives"
        shown = node(session("robot-2"), 0).id
        np.testing.assert_array_equal(store.words(bytes(16), [shown])[shown], [1, 5, 9])
        assert [one.robot for one in store.sessions.values()] == ["robot-1", "robot-2"]
    with Map.open(stored) as store:
        assert list(store.tags()) == ["both"]
        shown = store.sessions[session("robot-2").id]
        assert (shown.robot, shown.zone) == ("robot-9", "Europe/London")


def test_marks_and_omissions_read_as_written(stored: Path) -> None:
    with Map.open(stored) as store:
        (removal,) = store.removals
        assert removal.reason == "a test"
        assert len(store.load().edges) == 7
        assert store.anchors[0].x_m == 1.0
        assert store.anchors[0].z_m is None
        assert store.goals["dock"].node == node(session("robot-1"), 1).id
        assert set(store.placements) >= {node(session("robot-1"), index).id for index in range(4)}
        (omission,) = store.omissions.values()
        assert omission.omitted == OMITTED
        assert omission.node == node(session("robot-1"), 1).id
        assert store.landmark_hashes[OMITTED] == omission.landmark_hash == bytes(range(16))


def test_what_was_erased_has_left_its_receipts(stored: Path) -> None:
    gone = session("robot-5").id
    with closing(sqlite3.connect(stored)) as connection:
        found = connection.execute("SELECT record, count(*) FROM receipts GROUP BY record")
        assert dict(found) == {
            "sessions": 1, "nodes": 2, "frames": 2, "edges": 1, "paths": 1, "path_entries": 2,
            "attempts": 1, "placements": 2,
        }  # fmt: skip
    for at in (7, 8):
        with Map.open(stored, at=at) as store:
            assert gone not in {one.session for one in store.load().nodes}
            assert store.lookups.forgotten([gone]) == ({gone} if at == 8 else set())


@pytest.mark.parametrize(("at", "expected"), HASHES.items())
def test_content_hashes_stay(stored: Path, at: int, expected: str) -> None:
    with Map.open(stored, at=at) as store:
        assert store.content_hash() == store.verified_hash() == expected


def test_what_is_written_now_has_the_same_hashes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("engram.maps.revisions.__version__", "0.2.0a1")  # it is part of the history
    write_map(tmp_path / "now.engram")
    for at in range(1, 5):  # the fifth, an amendment, holds the time at which it was made
        with Map.open(tmp_path / "now.engram", at=at) as store:
            assert store.content_hash() == HASHES[at]


def test_it_is_sound_and_can_be_written_on(stored: Path) -> None:
    assert check_file(stored).problems == ()
    with Map.open(stored, writes=True) as store:
        with pytest.raises(IncompatibleError):
            begin(store, session("robot-4"), descriptor=TEBLID)
        assert store.session_state(session("robot-1").id) is SessionState.COMMITTED
        assert [one.session for one in store.interrupted()] == [session("robot-3")]
        assert store.seal(session("robot-3").id).contents["nodes"] == 2
        begin(store, session("robot-4")).commit()
        assert store.revision == max(HASHES) + 2
    assert check_file(stored).problems == ()


@pytest.mark.parametrize(
    ("version", "advice"),
    [
        (FORMAT_VERSION - 1, "reads only format 7: engram upgrade converts maps of format 6"),
        (FORMAT_VERSION + 1, "reads up to 7: upgrade Engram"),
    ],
)
def test_other_formats_are_refused_with_advice(stored: Path, version: int, advice: str) -> None:
    with sqlite3.connect(stored) as connection:
        connection.execute(f"PRAGMA user_version={version}")
    connection.close()
    for opener in (Map.open, partial(Map.open, writes=True), check_file):
        with pytest.raises(FormatVersionError, match=rf"map of format {version}, .*{advice}"):
            opener(stored)


def test_drafts_of_the_format_are_refused_with_advice(stored: Path) -> None:
    with closing(sqlite3.connect(stored)) as connection:
        connection.executescript("DROP TABLE forgotten; DROP TABLE receipts")
    for opener in (Map.open, check_file, upgrade_map):
        with pytest.raises(FormatVersionError, match=r"draft of format 7.*map the drives again"):
            opener(stored)


def test_the_page_on_the_format_is_of_this_format_and_includes_its_tables() -> None:
    page = PAGE.read_text()
    assert f"format {FORMAT_VERSION}" in page
    assert "generated/tables.md" in page
