"""The flight recorder: what it keeps, when it writes, and that its file is a drive."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from tests.builders import TOWN, TOWN_ROAD, World, drive

from engram.errors import EngramError, InputError, MapCorruptError
from engram.localiser.localisation import LocalisationStatus
from engram.maps.map import open_map
from engram.robot.front import Front
from engram.robot.recorder import Recorder, RecorderConfig
from engram.robot.settings import Settings
from engram.robot.starting import localise_drive
from engram.sequences.framelog.log_writer import read_decisions, read_images, read_report
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.opening import open_drive
from engram_lab.bench.data import synthetic_drive

ROAD = TOWN_ROAD[:29]
LIVE = drive(TOWN, ROAD + 0.2, seed=3, start_ns=10**15)
ELSEWHERE = drive(World(30.0, seed=9), ROAD + 0.2, seed=4, start_ns=10**15 + 4 * 10**9)


def test_a_lost_robot_writes_what_led_to_it_and_the_file_is_a_drive(
    town: Path, tmp_path: Path
) -> None:
    with open_map(town) as opened:
        with opened.robot(LIVE[0].frame.camera) as robot:
            robot.recorder = Recorder(tmp_path / "records", about={"map": "town"})
            found = [robot.step(one.logged) for one in [*LIVE[:20], *ELSEWHERE]]
        assert found[19].localised
        assert found[-1].status is LocalisationStatus.LOST
        (path,) = robot.recorder.written
        assert not robot.recorder.failure
        replayed = localise_drive(opened, open_drive(path))
    assert read_report(path)["reason"] == "lost"
    assert read_report(path)["map"] == "town"
    decisions = read_decisions(path)
    assert len(decisions) == len(replayed) > 20
    assert decisions[5]["status"] == "localised"
    assert sum(one.localised for one in replayed) >= 18


@pytest.fixture(scope="module")
def pairs():
    return list(synthetic_drive(frames=4, step_m=0.8))


@pytest.mark.parametrize("images", [True, False])
def test_images_are_kept_unless_they_are_private(pairs, tmp_path: Path, images: bool) -> None:
    path = recorded(pairs, tmp_path, images=images)
    log = FrameLog(path)
    assert len(log) == len(pairs)
    logged = log.read(1)
    kept = read_images(path, 1)
    assert (kept is not None) is images
    assert (logged.frame.thumbnail is not None) is images
    if kept is not None:
        left = kept[0].astype(float)
        assert np.abs(left - pairs[1].left).mean() < 4


def test_what_is_too_old_or_too_much_is_dropped(pairs, tmp_path: Path) -> None:
    assert len(FrameLog(recorded(pairs, tmp_path / "a", seconds=0.15))) == 2
    assert len(FrameLog(recorded(pairs, tmp_path / "b", most_bytes=1_000_000))) < len(pairs)


def test_two_records_of_one_second_are_two_files(town: Path, tmp_path: Path) -> None:
    with open_map(town) as opened, opened.robot(LIVE[0].frame.camera) as robot:
        robot.recorder = Recorder(str(tmp_path), about={"map": town})  # type: ignore[arg-type]
        robot.step(LIVE[0].logged)
        robot.record({"no", "JSON"})  # type: ignore[arg-type]
        asked = [robot.record(reason) for reason in ("a wall", "a hole")]
    assert robot.recorder.written == asked
    assert "not JSON serializable" in robot.recorder.failure
    assert [read_report(path)["reason"] for path in asked] == ["a wall", "a hole"]
    assert read_report(asked[0])["map"] == str(town)


def test_why_nothing_was_recorded_is_said(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path)
    path = recorder.record()
    recorder.close()
    assert not path.exists()
    assert "has seen no frame yet" in recorder.failure


def test_a_robot_without_a_recorder_says_what_to_do(town: Path) -> None:
    with (
        open_map(town) as opened,
        opened.robot(LIVE[0].frame.camera) as robot,
        pytest.raises(InputError, match="recorder"),
    ):
        robot.record()


@pytest.mark.parametrize("at", [0, 30, 2000, -2000, -1])
def test_a_damaged_record_is_a_clear_error_or_reads_as_it_was(
    pairs, tmp_path: Path, at: int
) -> None:
    path = recorded(pairs, tmp_path)
    content = bytearray(path.read_bytes())
    content[at] ^= 0x5A
    path.write_bytes(content)
    try:
        list(FrameLog(path))
        read_report(path)
        read_decisions(path)
        for number in range(len(pairs)):
            read_images(path, number)
    except EngramError as error:
        said = str(error)
        assert path.name in said or "frame log" in said


@pytest.mark.parametrize("table", ["images", "decisions", "report"])
def test_what_is_gone_from_a_record_is_missed(pairs, tmp_path: Path, table: str) -> None:
    path = recorded(pairs, tmp_path)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(f"DELETE FROM {table} WHERE rowid IN (SELECT max(rowid) FROM {table})")

    def read() -> None:
        read_decisions(path)
        read_images(path, 0)

    with pytest.raises(MapCorruptError, match=rf"written with {len(pairs)}|lost its report"):
        read()


def recorded(pairs, folder: Path, *, images: bool = True, **config: float) -> Path:
    """The record of a robot that was asked for one."""
    front = Front(Settings())
    recorder = Recorder(folder, images=images, config=RecorderConfig(**config))
    town = folder.with_suffix(".engram")
    with open_map(town, create=True) as empty, empty.robot(pairs[0].camera) as robot:
        for pair in pairs:
            frame, _ = front.take(pair)
            recorder.note(pair, frame, robot.step(pair), [])
    path = recorder.record()
    recorder.close()
    assert recorder.failure == ""
    return path
