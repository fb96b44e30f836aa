"""Logs beside maps: damage is found before SQLite takes it for the log's end."""

from __future__ import annotations

import shutil

import pytest

from engram.maps.map import Map
from engram.maps.map_files import check_file

from .maps import begin, session, write_drive

_HEADER, _FRAME = 32, 24 + 4096


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A map of two drives, of which the file beside its log knows none."""
    folder = tmp_path_factory.mktemp("logged")
    draft = folder / "draft.engram"
    with Map.create(draft) as store:
        for robot in ("r1", "r2"):
            writer = begin(store, session(robot))
            write_drive(writer, 2)
            writer.commit()
        for suffix in ("", "-wal"):
            shutil.copyfile(f"{draft}{suffix}", folder / f"town.engram{suffix}")
    return folder


@pytest.fixture
def logged(sound, tmp_path):
    for suffix in ("", "-wal"):
        shutil.copyfile(sound / f"town.engram{suffix}", tmp_path / f"town.engram{suffix}")
    return tmp_path / "town.engram"


def change(path, at: int, body: bytes) -> None:
    log = path.with_name("town.engram-wal")
    content = bytearray(log.read_bytes())
    content[at : at + len(body)] = body
    log.write_bytes(content)


def faults(path) -> list[str]:
    return [str(one) for one in check_file(path).problems]


def rows(path) -> int:
    """Of the map with its log, read from copies of both."""
    copy = path.with_name("copy.engram")
    for suffix in ("", "-wal"):
        shutil.copyfile(f"{path}{suffix}", f"{copy}{suffix}")
    return check_file(copy).rows


def test_a_sound_log_is_sound(logged):
    assert faults(logged) == []
    with Map.open(logged) as store:
        assert store.revision == 2


@pytest.mark.parametrize("at", [0, 8, 12, 16, 24])
def test_a_damaged_header_is_found(logged, at):
    change(logged, at, b"\x01\x02\x03\x04")
    assert "header" in faults(logged)[0]


@pytest.mark.parametrize("frame", [1, 3])
@pytest.mark.parametrize("at", [0, 4, 8, 12, 16, 24, 4000])
def test_a_damaged_frame_is_found_and_named(logged, frame, at):
    change(logged, _HEADER + (frame - 1) * _FRAME + at, b"\xfe\xdc\xba\x98")
    fact = faults(logged)[0]  # checking folds the rest of the log into the file
    assert f"frame {frame} " in fact
    assert "lost" in fact


@pytest.mark.parametrize("at", [0, 8, 16, 24, 4000])
def test_a_last_commit_in_parts_is_noted(logged, at):
    """A power cut leaves it so: some of its pages were written, and none was synced."""
    log = logged.with_name("town.engram-wal")
    frames = (len(log.read_bytes()) - _HEADER) // _FRAME
    before = rows(logged)
    change(logged, _HEADER + (frames - 1) * _FRAME + at, b"\xfe\xdc\xba\x98")
    report = check_file(logged)
    assert report.sound
    (note,) = report.notes
    assert note.startswith(f"town.engram-wal: its last commit is not whole from frame {frames} on")
    assert report.rows < before
    assert check_file(logged).notes == ()  # the check folded the rest of the log into the file


def test_a_log_that_ends_early_is_an_earlier_state(logged):
    log = logged.with_name("town.engram-wal")
    log.write_bytes(log.read_bytes()[: _HEADER + 20 * _FRAME + 100])
    assert faults(logged) == []
    with Map.open(logged) as store:
        assert store.revision < 2


def test_frames_that_an_older_log_left_are_no_damage(logged):
    """SQLite begins a log again over the old one, with another salt."""
    log = logged.with_name("town.engram-wal")
    content = log.read_bytes()
    older = bytearray(content[_HEADER : _HEADER + _FRAME])
    salt = int.from_bytes(content[16:20], "big") - 1
    older[8:16] = salt.to_bytes(4, "big") + b"salt"
    log.write_bytes(content + older)
    assert faults(logged) == []
    assert check_file(logged).rows


def test_the_log_of_a_living_writer_is_not_judged(logged):
    change(logged, _HEADER + 24, b"\xff\xff")
    with Map.open(logged, writes=True):
        assert faults(logged) == []
