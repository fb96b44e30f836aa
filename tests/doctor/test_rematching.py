"""A map tells a robot by how much its focal length or baseline is wrong."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.builders import CAMERA, Seen, World, drive
from tests.scenes import Scene

from engram.doctor.examination import APART, FACTORS, MOST, Examination, Rematched
from engram.doctor.table import Finding
from engram.frontend.matching import Match, MatcherConfig, match_frames
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.maps.map import open_map
from engram.robot.robot import Robot
from engram.robot.settings import Settings
from engram.sequences.sequence import LoggedFrame

HERE = SE3.exp([0.3, -0.05, 1.0, 0.02, 0.06, 0.01])
WORLD = World(40.0)
ROAD = np.arange(0.0, 30.0, 0.7)


def wrong(camera: StereoCamera, focal: float = 1.0, baseline: float = 1.0) -> StereoCamera:
    return replace(
        camera,
        fx=camera.fx * focal,
        fy=camera.fy * focal,
        baseline_m=camera.baseline_m * baseline,
    )


def rematched(focal: float = 1.0, baseline: float = 1.0, elsewhere: bool = False) -> Rematched:
    found = Rematched()
    for seed in range(4):
        scene = Scene(500, seed)
        reference, _ = scene.seen_from(SE3.identity())
        seen, _ = (Scene(500, 50 + seed) if elsewhere else scene).seen_from(HERE, outliers=0.3)
        live = replace(seen, camera=wrong(seen.camera, focal, baseline))
        found.add(reference, live, MatcherConfig())
    return found


@pytest.mark.parametrize("by", [0.8, 0.92, 1.08, 1.13, 1.25])
def test_a_wrong_focal_length_is_told_by_what_fits_a_map_best(by: float) -> None:
    found = rematched(focal=by)
    assert found.focal_factor == pytest.approx(by, rel=0.015)
    assert found.baseline_factor == 1.0


@pytest.mark.parametrize("by", [0.8, 1.1, 1.25])
def test_so_is_a_wrong_baseline(by: float) -> None:
    found = rematched(baseline=by)
    assert found.baseline_factor == pytest.approx(by, rel=0.015)
    assert found.focal_factor == 1.0


def test_a_right_calibration_fits_best_and_another_place_tells_nothing() -> None:
    found = rematched()
    assert (found.focal_factor, found.baseline_factor) == (1.0, 1.0)
    found = rematched(elsewhere=True)
    assert (found.focal_factor, found.baseline_factor) == (None, None)
    assert Rematched().focal_factor is None


@pytest.fixture
def mapped(tmp_path: Path) -> Path:
    path = tmp_path / "town.engram"
    with (
        open_map(path, create=True) as opened,
        opened.robot(CAMERA, Settings(), name="r1", maps=True) as robot,
    ):
        run(robot, drive(WORLD, ROAD))
        # What a robot matches of its own drive has its own calibration.
        assert robot.diagnosis.untold.keys() >= {"focal_length_off", "baseline_off"}
    return path


def run(robot: Robot, frames: list[Seen]) -> None:
    for seen in frames:
        robot.step(seen.logged)


def localised_by(path: Path, camera: StereoCamera) -> Iterator[Finding]:
    with open_map(path) as opened, opened.robot(camera) as robot:
        for seen in drive(WORLD, ROAD + 0.3, seed=1, start_ns=10**15):
            frame = replace(seen.frame, camera=camera)
            robot.step(LoggedFrame(frame, seen.odometry))
        assert not {"focal_length_off", "baseline_off"} & set(robot.diagnosis.untold)
        yield from robot.diagnosis.findings


@pytest.mark.parametrize(
    ("focal", "baseline", "code", "words"),
    [
        (1.1, 1.0, "focal_length_off", "focal length is too long"),
        (1 / 1.1, 1.0, "focal_length_off", "focal length is too short"),
        (1.0, 1.1, "baseline_off", "baseline is too long"),
        (1.0, 1 / 1.1, "baseline_off", "baseline is too short"),
    ],
)
def test_a_robot_that_localises_is_told_that_its_calibration_is_wrong(
    mapped: Path, focal: float, baseline: float, code: str, words: str
) -> None:
    (found,) = (
        one
        for one in localised_by(mapped, wrong(CAMERA, focal, baseline))
        if one.code.endswith("_off")
    )
    assert found.code == code
    assert words in found.message
    # Of the few frames that were fixed and matched again.
    assert found.value == pytest.approx(abs(focal * baseline - 1), abs=0.02)


def test_of_a_right_calibration_it_hears_nothing(mapped: Path) -> None:
    assert not [one for one in localised_by(mapped, CAMERA) if one.code.endswith("_off")]


def test_a_robot_matches_nothing_again_until_it_is_asked(
    mapped: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []

    def counted(*args: Any) -> Match:
        made.append(1)
        return match_frames(*args)

    monkeypatch.setattr("engram.doctor.examination.match_frames", counted)
    with open_map(mapped) as opened:
        with opened.robot(CAMERA) as robot:
            run(robot, drive(WORLD, ROAD + 0.3, seed=1, start_ns=10**15))
        assert not made
        assert not {"focal_length_off", "baseline_off"} & set(robot.diagnosis.untold)
    matched = len(made)
    assert matched >= 2 * len(FACTORS)
    assert robot.diagnosis
    assert len(made) == matched


def test_only_so_many_frames_are_matched_again() -> None:
    examination = Examination()
    scene = Scene(300, 0)
    frame, _ = scene.seen_from(SE3.identity())
    matched = []
    for number in range(300):
        if examination.wants_match():
            examination.match(frame, frame, MatcherConfig())
            matched.append(number)
    assert len(matched) == MOST
    assert set(np.diff(matched)) == {APART}
