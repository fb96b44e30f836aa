"""Recording a drive: interrupted, gone on with, refused where it is another drive's."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from engram.errors import IncompatibleError, SequenceError
from engram.monitor import Advancing
from engram.robot.mapping import extract_log
from engram.robot.settings import Settings
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.opening import open_drive

PAIRS = 6


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A plain folder of six textured pairs, the right image shifted by 8 px."""
    path = tmp_path / "monday"
    (path / "left").mkdir(parents=True)
    (path / "right").mkdir()
    noise = np.random.default_rng(4).integers(0, 256, (240, 400), dtype=np.uint8)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    for index in range(PAIRS):
        left = texture[:, 10 + index : 330 + index]
        right = texture[:, 18 + index : 338 + index]
        cv2.imwrite(str(path / "left" / f"{index}.png"), left)
        cv2.imwrite(str(path / "right" / f"{index}.png"), right)
    (path / "times.txt").write_text("".join(f"{index / 10}\n" for index in range(PAIRS)))
    (path / "calibration.toml").write_text(
        "[rectified]\nfx = 300.0\nfy = 300.0\ncx = 159.5\ncy = 119.5\n"
        "baseline_m = 0.2\nwidth = 320\nheight = 240\n"
    )
    return path


def test_an_interrupted_recording_equals_one_in_one_go(drive: Path, tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole.framelog", tmp_path / "parts.framelog"
    extract_log(open_drive(drive), whole, Settings())
    calls = 0

    def interrupt(word: str) -> None:
        nonlocal calls
        calls += 1
        if calls == 3:
            raise KeyboardInterrupt

    first = extract_log(open_drive(drive), parts, Settings(), Advancing(interrupt))
    assert first.interrupted
    assert not FrameLog(parts).complete
    second = extract_log(open_drive(drive), parts, Settings())
    assert (second.already_recorded, second.frames) == (3, PAIRS - 3)
    logs = [FrameLog(path) for path in (whole, parts)]
    assert all(log.complete for log in logs)
    for one, other in zip(*logs, strict=True):
        assert one.frame.stamp_ns == other.frame.stamp_ns
        np.testing.assert_array_equal(
            one.frame.landmarks.descriptors, other.frame.landmarks.descriptors
        )
        assert one.odometry.status is other.odometry.status


def test_a_drive_that_breaks_off_is_not_called_complete(drive: Path, tmp_path: Path) -> None:
    (drive / "left" / "4.png").write_bytes(b"")
    log = tmp_path / "a.framelog"
    with pytest.raises(SequenceError, match=r"4\.png"):
        extract_log(open_drive(drive), log, Settings())
    assert not FrameLog(log).complete
    assert len(FrameLog(log)) == 4


def test_other_frames_do_not_go_into_the_same_log(drive: Path, tmp_path: Path) -> None:
    log = tmp_path / "a.framelog"
    extract_log(open_drive(drive), log, Settings())
    with pytest.raises(IncompatibleError, match="choice of frames"):
        extract_log(open_drive(drive, frames="::2"), log, Settings())


def test_other_images_do_not_go_into_the_same_log(drive: Path, tmp_path: Path) -> None:
    log = tmp_path / "a.framelog"
    extract_log(open_drive(drive), log, Settings())
    (drive / "left" / "0.png").write_bytes((drive / "left" / "1.png").read_bytes())
    with pytest.raises(IncompatibleError, match="other images"):
        extract_log(open_drive(drive), log, Settings())


def test_a_drive_without_a_readable_pair_is_told(drive: Path, tmp_path: Path) -> None:
    for image in (drive / "right").iterdir():
        image.write_bytes(b"no image")
    with pytest.raises(SequenceError, match="no frame can be read"):
        extract_log(open_drive(drive, skip_bad=True), tmp_path / "a.framelog", Settings())


def test_a_log_is_not_extracted_again(drive: Path, tmp_path: Path) -> None:
    log = tmp_path / "a.framelog"
    extract_log(open_drive(drive), log, Settings())
    with pytest.raises(SequenceError, match="already a frame log"):
        extract_log(open_drive(log), tmp_path / "b.framelog", Settings())
