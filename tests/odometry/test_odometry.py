"""Odometry on a synthetic drive with known motion: accuracy, honesty, failures, recovery, rest."""

import dataclasses

import numpy as np
import pytest
from tests.scenes import AS_SIMULATED, CAMERA, Scene, normalised_error

from engram.errors import ConfigError, IncompatibleError
from engram.frontend.frame import Frame, FrameStatus
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.odometry.odometry import Odometry, OdometryConfig, WindowConfig
from engram.odometry.step import OdometryStatus
from engram_lab.teblid import TEBLID

MOTION = SE3.exp([0.03, 0.0, 0.4, 0.0, 0.015, 0.002])
INTERVAL_NS = 100_000_000
# The noise of the scenes.
AS_DRIVEN = OdometryConfig(
    matcher=AS_SIMULATED,
    window=WindowConfig(offset_sigma_px=1e-3),
    few_inliers=0,
)


def drive(
    count: int, seed: int, motion: SE3 = MOTION, offset_px: float = 0.0
) -> tuple[list[Frame], list[SE3]]:
    scene = Scene(1500, seed)
    poses, frames = [SE3.identity()], []
    for k in range(count):
        frames.append(scene.seen_from(poses[-1], stamp_ns=k * INTERVAL_NS, offset_px=offset_px)[0])
        poses.append(poses[-1] @ motion)
    return frames, poses[:count]


def unusable(frame: Frame) -> Frame:
    return dataclasses.replace(frame, status=FrameStatus.DARK)


def test_follows_a_drive_with_honest_covariance() -> None:
    errors = []
    for seed in range(4):
        frames, _ = drive(12, seed)
        odometry = Odometry(AS_DRIVEN)
        steps = [odometry.step(frame) for frame in frames]
        assert steps[0].status is OdometryStatus.FIRST
        assert steps[0].prev_from_curr is None
        for step in steps[1:]:
            assert step.status is OdometryStatus.OK
            assert step.prev_from_curr is not None
            assert step.covariance is not None
            # Three standard deviations of a single match of this noise are 2 cm.
            assert (step.prev_from_curr @ MOTION.inverse()).distance_m < 0.02
            errors.append(normalised_error(step.prev_from_curr, step.covariance, MOTION))
    # Mean 6 where exact; robust weights make the covariance err on the large side.
    assert 2.5 < np.mean(errors) < 8


def test_an_offset_of_all_disparities_is_learnt() -> None:
    """A rectification that is off by 0.25 px would shorten this drive by 5 %."""
    shares = []
    for seed in range(3):
        frames, _ = drive(25, seed, offset_px=0.25)
        odometry = Odometry()
        late = [odometry.step(frame).prev_from_curr for frame in frames][12:]
        driven = sum(motion.distance_m for motion in late if motion is not None)
        shares.append(driven / (len(late) * MOTION.distance_m))
    assert np.mean(shares) == pytest.approx(1, abs=0.01)


def test_at_rest_errors_do_not_add_up() -> None:
    frames, _ = drive(60, 1, motion=SE3.identity())
    odometry = Odometry()
    end, furthest = SE3.identity(), 0.0
    for step in [odometry.step(frame) for frame in frames][1:]:
        assert step.prev_from_curr is not None
        end = end @ step.prev_from_curr
        furthest = max(furthest, end.distance_m)
    # One match of this scene is good to 3 mm; sixty in a row would random-walk to 2 cm.
    assert furthest < 0.01


def test_a_gap_is_bridged_by_the_next_usable_frame() -> None:
    frames, poses = drive(6, 2)
    frames[3] = unusable(frames[3])
    odometry = Odometry()
    steps = [odometry.step(frame) for frame in frames]
    assert steps[3].status is OdometryStatus.UNUSABLE_FRAME
    assert steps[3].prev_from_curr is None
    assert steps[3].inliers == 0
    end = SE3.identity()
    for step in steps:
        if step.prev_from_curr is not None:
            end = end @ step.prev_from_curr
    assert (end @ poses[5].inverse()).distance_m < 0.05
    assert steps[4].prev_from_curr is not None
    assert (steps[4].prev_from_curr @ (MOTION @ MOTION).inverse()).distance_m < 0.03


def test_another_place_breaks_the_chain_and_the_next_frame_begins_a_new_one() -> None:
    here, _ = drive(3, 3)
    there, _ = drive(3, 4)
    later = [
        dataclasses.replace(frame, stamp_ns=frame.stamp_ns + 3 * INTERVAL_NS) for frame in there
    ]
    odometry = Odometry()
    steps = [odometry.step(frame) for frame in here + later]
    assert steps[3].status is OdometryStatus.NO_CONSENSUS
    assert steps[3].prev_from_curr is None
    assert steps[3].covariance is None
    for step in steps[4:]:
        assert step.status is OdometryStatus.OK
        assert step.prev_from_curr is not None
        assert (step.prev_from_curr @ MOTION.inverse()).distance_m < 0.02


def test_a_sudden_turn_is_found_without_the_prediction() -> None:
    scene = Scene(3000, 5)
    poses = [MOTION, MOTION @ MOTION]
    poses.append(poses[-1] @ SE3.exp([0, 0, 0.2, 0, 0.35, 0]))  # 20° at once
    odometry = Odometry()
    step = None
    for k, pose in enumerate([SE3.identity(), *poses]):
        step = odometry.step(scene.seen_from(pose, stamp_ns=k * INTERVAL_NS)[0])
    assert step is not None
    assert step.prev_from_curr is not None
    assert (step.prev_from_curr @ poses[-1].inverse() @ poses[-2]).distance_m < 0.03


def test_unusable_frames_at_the_start_are_passed_over() -> None:
    frames, _ = drive(3, 6)
    odometry = Odometry()
    statuses = [odometry.step(frame).status for frame in [unusable(frames[0]), *frames[1:]]]
    assert statuses == [
        OdometryStatus.UNUSABLE_FRAME,
        OdometryStatus.FIRST,
        OdometryStatus.OK,
    ]


def test_few_landmarks_in_common_are_too_few() -> None:
    frames, _ = drive(2, 7)
    odometry = Odometry(OdometryConfig(min_inliers=100_000))
    statuses = [odometry.step(frame).status for frame in frames]
    assert statuses[1] is OdometryStatus.TOO_FEW_MATCHES


def test_the_window_costs_the_same_however_long_the_robot_has_run() -> None:
    """There and back past one scene: some landmarks stay in sight, and keep their tracks alive."""
    frames, _ = drive(8, 10)
    odometry = Odometry()
    tracks = []
    for k in range(400):
        at = k % 14
        frame = frames[min(at, 14 - at)]
        odometry.step(dataclasses.replace(frame, stamp_ns=k * INTERVAL_NS))
        tracks.append(odometry._core.tracks)
    assert max(tracks[200:]) <= max(tracks[20:200])


def test_same_frames_same_bits() -> None:
    frames, _ = drive(6, 8)
    first, second = Odometry(), Odometry()
    for frame in frames:
        a, b = first.step(frame), second.step(frame)
        if a.prev_from_curr is not None and b.prev_from_curr is not None:
            np.testing.assert_array_equal(a.prev_from_curr.matrix(), b.prev_from_curr.matrix())
            np.testing.assert_array_equal(a.covariance, b.covariance)


def test_another_camera_or_descriptor_is_a_clear_error() -> None:
    frames, _ = drive(2, 9)
    odometry = Odometry()
    odometry.step(frames[0])
    other = StereoCamera(
        CAMERA.fx + 1, CAMERA.fy, CAMERA.cx, CAMERA.cy, CAMERA.baseline_m, 512, 384
    )
    with pytest.raises(IncompatibleError, match="camera changed"):
        odometry.step(dataclasses.replace(frames[1], camera=other))
    with pytest.raises(IncompatibleError, match="descriptors"):
        odometry.step(dataclasses.replace(frames[1], descriptor=TEBLID))


@pytest.mark.parametrize(
    "senseless",
    [
        lambda: OdometryConfig(min_inliers=3),
        lambda: WindowConfig(frames=1),
        lambda: WindowConfig(landmarks=0),
    ],
)
def test_senseless_settings_are_refused(senseless) -> None:
    with pytest.raises(ConfigError):
        senseless()
