"""Odometry on a synthetic drive with known motion: accuracy, honesty, failures, recovery, rest."""

import dataclasses

import numpy as np
import pytest
from tests.scenes import AS_SIMULATED, CAMERA, Scene, normalised_error

from engram.errors import ConfigError, IncompatibleError
from engram.frontend.frame import Frame, FrameStatus, Landmarks
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
    window=WindowConfig(pixel_sigma_px=0.5, disparity_sigma_px=1e-6, offset_sigma_px=1e-3),
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


def riding_along(frames: list[Frame], count: int, seed: int, least_px: float = 3.0) -> list[Frame]:
    """The frames with so many landmarks that keep their pixels, as drops on the lens do.

    Args:
        least_px: their least disparity.
    """
    rng = np.random.default_rng(seed)
    disparity_px = rng.uniform(least_px, 20, count)
    pixels = np.column_stack([rng.uniform(0, 512, count), rng.uniform(0, 384, count)])
    depth_m = CAMERA.focal_baseline / disparity_px
    rays = (pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    there = Landmarks(
        pixels=pixels.astype(np.float32),
        disparity_px=disparity_px.astype(np.float32),
        disparity_sigma_px=np.full(count, 0.15, np.float32),
        points_in_cam=(np.column_stack([rays, np.ones(count)]) * depth_m[:, None]).astype("f4"),
        descriptors=rng.integers(0, 256, (count, 32), dtype=np.uint8),
        octaves=np.zeros(count, np.uint8),
    )
    names = [one.name for one in dataclasses.fields(Landmarks)]
    return [
        dataclasses.replace(
            frame,
            landmarks=Landmarks(
                **{
                    name: np.concatenate([getattr(frame.landmarks, name), getattr(there, name)])
                    for name in names
                }
            ),
        )
        for frame in frames
    ]


def test_of_two_motions_the_one_at_the_last_speed_needs_fewer_landmarks() -> None:
    """Drops come on the lens while the robot drives; more of them agree than of the world."""
    slow, _ = drive(9, 11, motion=SE3.exp([0.0, 0.0, 0.7, 0.0, 0.01, 0.0]))
    frames = [dataclasses.replace(one, stamp_ns=3 * one.stamp_ns) for one in slow]
    dry = Odometry()
    world = [dry.step(frame).inliers for frame in frames][-1]
    wet = frames[:6] + riding_along(frames[6:], round(1.4 * world), 3)
    steps = []
    for share in (OdometryConfig().steady_share, 1.0):
        odometry = Odometry(OdometryConfig(steady_share=share))
        steps.append([odometry.step(frame) for frame in wet][-1])
    steady, most = steps
    assert steady.moved_m == pytest.approx(0.7, abs=0.03)
    assert most.moved_m < 0.6
    assert most.inliers > 1.2 * steady.inliers


def newest(frame: Frame, count: int) -> Frame:
    """The frame with its last landmarks alone."""
    names = [one.name for one in dataclasses.fields(Landmarks)]
    last = Landmarks(**{name: getattr(frame.landmarks, name)[-count:] for name in names})
    return dataclasses.replace(frame, landmarks=last)


def test_the_speed_before_an_impossible_stop_is_remembered() -> None:
    """For a second nothing is seen but the robot's own beam, then the world again, too."""
    slow, _ = drive(16, 11, motion=SE3.exp([0.0, 0.0, 0.7, 0.0, 0.01, 0.0]))
    frames = [dataclasses.replace(one, stamp_ns=3 * one.stamp_ns // 2) for one in slow]
    count = 500  # 200 of the world will agree, between a third and half of that
    lit = riding_along(frames, count, 3, least_px=15)
    night = frames[:4] + lit[4:6] + [newest(one, count) for one in lit[6:12]] + lit[12:]
    moved = []
    for seconds in (OdometryConfig().disbelief_s, 0.0):
        odometry = Odometry(OdometryConfig(disbelief_s=seconds))
        moved.append([odometry.step(frame) for frame in night])
    remembering, forgetful = moved
    for step in remembering[6:12]:
        assert step.moved_m < 0.1
        assert step.covariance is not None
        assert step.covariance[2, 2] > 0.5**2
    for step in remembering[13:]:
        assert step.moved_m == pytest.approx(0.7, abs=0.03)
        assert step.covariance is not None
        assert step.covariance[2, 2] < 0.1**2
    assert all(step.moved_m < 0.1 for step in forgetful[13:])


@pytest.mark.parametrize("late", [0.0, 0.05])
def test_a_robot_that_brakes_is_believed(late: float) -> None:
    """With 8 m/s², the stamps of every other frame so many seconds late."""
    scene, odometry = Scene(3000, 12), Odometry()
    pose, speed_m_s = SE3.identity(), 5.0
    for k in range(14):
        stamp_ns = k * INTERVAL_NS + (k % 2) * round(late * 1e9)
        step = odometry.step(scene.seen_from(pose, stamp_ns=stamp_ns)[0])
        if step.prev_from_curr is not None:
            assert step.covariance is not None
            assert step.covariance[2, 2] < 0.03**2
        speed_m_s = max(speed_m_s - 0.8 * (k > 5), 0.0)
        pose = pose @ SE3.exp([0.0, 0.0, 0.1 * speed_m_s, 0.0, 0.0, 0.0])


def test_a_sudden_stop_is_believed_where_the_world_stands() -> None:
    frames, poses = drive(8, 13, motion=SE3.exp([0.0, 0.0, 0.7, 0.0, 0.0, 0.0]))
    scene = Scene(1500, 13)
    stands = [scene.seen_from(poses[-1], stamp_ns=(8 + k) * INTERVAL_NS)[0] for k in range(3)]
    odometry = Odometry()
    steps = [odometry.step(frame) for frame in [*frames, *stands]]
    for step in steps[-3:]:
        assert step.prev_from_curr is not None
        assert step.prev_from_curr.distance_m < 0.01


def test_what_is_dragged_along_a_little_does_not_shorten_a_step() -> None:
    """A quarter of the corners moves a pixel less than it should, as blur has it."""
    errors_m = []
    for pixel_sigma_px in (WindowConfig().pixel_sigma_px, 0.65):
        scene = Scene(1500, 14)
        odometry = Odometry(OdometryConfig(window=WindowConfig(pixel_sigma_px=pixel_sigma_px)))
        pose, off = SE3.identity(), []
        for k in range(14):
            frame, _ = scene.seen_from(pose, pixel_sigma_px=0.1, stamp_ns=k * INTERVAL_NS)
            pixels = frame.landmarks.pixels.copy()
            away = pixels - [CAMERA.cx, CAMERA.cy]
            far = np.linalg.norm(away, axis=1, keepdims=True)
            pixels[::4] -= (k % 2) * (away / np.maximum(far, 1.0))[::4]
            landmarks = dataclasses.replace(frame.landmarks, pixels=pixels.astype(np.float32))
            step = odometry.step(dataclasses.replace(frame, landmarks=landmarks))
            if step.prev_from_curr is not None:
                off.append((step.prev_from_curr @ MOTION.inverse()).distance_m)
            pose = pose @ MOTION
        errors_m.append(float(np.median(off)))
    assert errors_m[0] < 0.7 * errors_m[1]


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
    # Seeds of the matches differ from pass to pass: a track more or less.
    assert max(tracks[200:]) <= 1.01 * max(tracks[20:200])


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
        lambda: WindowConfig(pixel_sigma_px=0.0),
        lambda: OdometryConfig(steady_share=1.5),
        lambda: OdometryConfig(braking_share=0.0),
    ],
)
def test_senseless_settings_are_refused(senseless) -> None:
    with pytest.raises(ConfigError):
        senseless()
