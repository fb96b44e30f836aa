"""Matching two frames: the pose, its covariance, wrong matches, other cameras, determinism."""

import dataclasses
from uuid import UUID

import numpy as np
import pytest
from tests.instruction_sets import printed
from tests.scenes import AS_SIMULATED, CAMERA, Scene, normalised_error

from engram import _core
from engram.errors import ConfigError, IncompatibleError, InputError
from engram.frontend.matching import (
    MatcherConfig,
    core_settings,
    features,
    match_frames,
    matcher_hash,
    pair_seed,
)
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram_lab.teblid import TEBLID

CONFIG = MatcherConfig()
REFERENCE_FROM_LIVE = SE3.exp([0.2, -0.05, 1.0, 0.02, 0.1, 0.01])
WIDER = StereoCamera(fx=220.0, fy=225.0, cx=330.0, cy=236.0, baseline_m=0.5, width=640, height=480)


@pytest.mark.parametrize("outliers", [0.0, 0.5, 0.8, 0.9])
def test_finds_the_pose_among_wrong_matches(outliers: float) -> None:
    for seed in range(10):
        scene = Scene(500, seed)
        reference, points_of_reference = scene.seen_from(SE3.identity())
        live, points_of_live = scene.seen_from(REFERENCE_FROM_LIVE, outliers=outliers)
        match = match_frames(reference, live, CONFIG, seed)
        assert match.reference_from_live is not None
        # 0.1 m: five standard deviations at 90 % outliers, where some 40 points agree.
        error = match.reference_from_live @ REFERENCE_FROM_LIVE.inverse()
        assert error.distance_m < 0.1
        right = points_of_reference[match.reference_rows] == points_of_live[match.live_rows]
        assert right.mean() > 0.95
        assert match.inliers == len(match.live_rows) == len(match.reference_rows)


def test_covariance_is_honest() -> None:
    errors = []
    for seed in range(60):
        scene = Scene(400, seed)
        reference, _ = scene.seen_from(SE3.identity())
        live, _ = scene.seen_from(REFERENCE_FROM_LIVE, outliers=0.3)
        match = match_frames(reference, live, AS_SIMULATED, seed)
        assert match.reference_from_live is not None
        assert match.covariance is not None
        errors.append(
            normalised_error(match.reference_from_live, match.covariance, REFERENCE_FROM_LIVE)
        )
    # χ² with 6 degrees of freedom: mean 6, standard error of 60 samples 0.45. The robust weights
    # discount good landmarks a little, so that the covariance errs on the large side.
    assert 3 < np.mean(errors) < 7.5


def test_a_map_made_with_one_camera_serves_another() -> None:
    for seed in range(5):
        scene = Scene(600, seed)
        reference, _ = scene.seen_from(SE3.identity())
        live, _ = scene.seen_from(REFERENCE_FROM_LIVE, WIDER, outliers=0.3)
        match = match_frames(reference, live, CONFIG, seed)
        assert match.reference_from_live is not None
        assert match.covariance is not None
        chi2 = normalised_error(match.reference_from_live, match.covariance, REFERENCE_FROM_LIVE)
        assert chi2 < 22.5  # χ² with 6 degrees of freedom: 99.9 %


def test_agrees_with_poselib() -> None:
    poselib = pytest.importorskip("poselib")
    scene = Scene(500, 3)
    reference, _ = scene.seen_from(SE3.identity())
    live, _ = scene.seen_from(REFERENCE_FROM_LIVE, outliers=0.6)
    match = match_frames(reference, live, CONFIG, 3)
    assert match.reference_from_live is not None
    rows, columns = _core.match_rows(features(reference), features(live), core_settings(CONFIG))
    camera = {
        "model": "PINHOLE",
        "width": CAMERA.width,
        "height": CAMERA.height,
        "params": [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy],
    }
    pose, info = poselib.estimate_absolute_pose(
        live.landmarks.pixels[columns].astype(np.float64),
        reference.landmarks.points_in_cam[rows].astype(np.float64),
        camera,
        {"max_reproj_error": 3.0, "seed": 1},
        {},
    )
    theirs = SE3(pose.R, pose.t).inverse()
    # PoseLib knows neither disparity nor depth errors: the two agree within its own error.
    assert (theirs @ match.reference_from_live.inverse()).distance_m < 0.1
    assert match.inliers > 0.8 * info["num_inliers"]


def test_refinement_reaches_the_minimum() -> None:
    """The pose found has less robust cost than any other nearby (independent NumPy cost)."""
    scene = Scene(300, 8)
    reference, _ = scene.seen_from(SE3.identity())
    live, _ = scene.seen_from(REFERENCE_FROM_LIVE, WIDER)
    match = match_frames(reference, live, AS_SIMULATED, 8)
    assert match.reference_from_live is not None
    assert match.covariance is not None

    def cost(reference_from_live: SE3) -> float:
        a, b = reference.landmarks, live.landmarks
        rows, columns = match.reference_rows, match.live_rows
        points = a.points_in_cam[rows].astype(float)
        relative_sigma = a.disparity_sigma_px[rows] / a.disparity_px[rows]

        def stereo(points_in_reference: np.ndarray) -> np.ndarray:
            x, y, z = (reference_from_live.inverse() @ points_in_reference).T
            return np.column_stack(
                [
                    WIDER.fx * x / z + WIDER.cx,
                    WIDER.fy * y / z + WIDER.cy,
                    WIDER.focal_baseline / z,
                ]
            )

        residual = stereo(points) - np.column_stack([b.pixels[columns], b.disparity_px[columns]])
        by_depth = (stereo(points * (1 + 1e-6)) - stereo(points * (1 - 1e-6))) / 2e-6
        magnification = (
            WIDER.fx / CAMERA.fx * points[:, 2] / b.points_in_cam[columns, 2].astype(float)
        )
        total = 0.0
        for i in range(len(rows)):
            pixel_variance = AS_SIMULATED.pixel_sigma_px**2 * (1 + magnification[i] ** 2)
            information = np.diag(
                [1 / pixel_variance, 1 / pixel_variance, b.disparity_sigma_px[columns[i]] ** -2]
            )
            covariance = np.linalg.inv(information)
            covariance += relative_sigma[i] ** 2 * np.outer(by_depth[i], by_depth[i])
            chi2 = residual[i] @ np.linalg.solve(covariance, residual[i])
            total += chi2 / (1 + chi2 / AS_SIMULATED.chi2)
        return total

    # Half a standard deviation to either side along each principal axis costs about 1/4 each;
    # outliers that the kernel's sum has besides change little over so short a way.
    values, vectors = np.linalg.eigh(match.covariance)
    here = cost(match.reference_from_live)
    for value, vector in zip(values, vectors.T, strict=True):
        for side in (-0.5, 0.5):
            moved = SE3.exp(side * np.sqrt(value) * vector) @ match.reference_from_live
            assert cost(moved) > here


@pytest.mark.parametrize("seed", range(5))
def test_different_places_do_not_match(seed: int) -> None:
    reference, _ = Scene(500, 2 * seed).seen_from(SE3.identity())
    live, _ = Scene(500, 2 * seed + 1).seen_from(SE3.identity())
    match = match_frames(reference, live, MatcherConfig(max_distance=110, ratio=0.99), seed)
    assert match.reference_from_live is None
    assert match.covariance is None
    assert match.inliers == 0
    assert len(match.reference_rows) == len(match.live_rows) == 0


def test_no_landmarks_no_match() -> None:
    scene = Scene(300, 1)
    some, _ = scene.seen_from(SE3.identity())
    none, _ = scene.seen_from(SE3.exp([0, 0, 1000.0, 0, 0, 0]))
    for reference, live in [(some, none), (none, some), (none, none)]:
        assert match_frames(reference, live, CONFIG, 0).reference_from_live is None


def test_prediction_finds_what_descriptors_alone_do_not_tell_apart() -> None:
    scene = Scene(500, 5)
    scene.descriptors[:] = scene.descriptors[np.arange(500) // 2]  # each looks like another
    reference, _ = scene.seen_from(SE3.identity())
    live, points_of_live = scene.seen_from(REFERENCE_FROM_LIVE)
    predicted = SE3.exp([0.05, 0.02, -0.04, 0.004, -0.003, 0.002]) @ REFERENCE_FROM_LIVE
    covariance = np.diag([0.05, 0.05, 0.05, 0.005, 0.005, 0.005]) ** 2
    blind = match_frames(reference, live, MatcherConfig(second_pass=False), 5)
    guided = match_frames(reference, live, CONFIG, 5, predicted, covariance)
    assert guided.reference_from_live is not None
    assert guided.inliers > 0.7 * len(points_of_live)
    assert guided.inliers > 2 * blind.inliers  # patch sizes tell some apart unguided
    error = guided.reference_from_live @ REFERENCE_FROM_LIVE.inverse()
    assert error.distance_m < 0.02


def test_the_rows_found_near_a_prediction_are_those_of_a_plain_search() -> None:
    scene = Scene(120, 6)
    reference, _ = scene.seen_from(SE3.identity())
    live, _ = scene.seen_from(REFERENCE_FROM_LIVE)
    covariance = np.diag([0.1, 0.1, 0.1, 0.01, 0.01, 0.01]) ** 2
    rows, columns = _core.match_rows(
        features(reference),
        features(live),
        core_settings(CONFIG),
        REFERENCE_FROM_LIVE.matrix(),
        covariance,
    )
    distances = _core.hamming_matrix(
        reference.landmarks.descriptors, live.landmarks.descriptors
    ).astype(int)
    # With a true prediction all nearest neighbours lie within their windows.
    best = distances.argmin(axis=1)
    expected = {
        (i, j)
        for i, j in enumerate(best)
        if distances[i, j] <= CONFIG.max_guided_distance and distances[:, j].argmin() == i
    }
    found = set(zip(rows.tolist(), columns.tolist(), strict=True))
    # 1 % of the right ones lie outside of three standard deviations.
    assert found <= expected
    assert len(found) >= 0.95 * len(expected)


def test_unguided_rows_are_those_of_brute_force() -> None:
    scene = Scene(200, 7)
    reference, _ = scene.seen_from(SE3.identity())
    live, _ = scene.seen_from(REFERENCE_FROM_LIVE, flipped_bits=0.2)
    config = MatcherConfig(patch_ratio=100.0, same_corner_px=1e-3)
    rows, columns = _core.match_rows(features(reference), features(live), core_settings(config))
    distances = _core.hamming_matrix(
        reference.landmarks.descriptors, live.landmarks.descriptors
    ).astype(int)
    expected = set()
    for i, row in enumerate(distances):
        first, second = np.sort(row)[:2]
        j = int(row.argmin())
        distinct = first <= config.max_distance and int(first / config.ratio) < second
        if distinct and distances[:, j].argmin() == i:
            expected.add((i, j))
    assert len(expected) > 50
    assert set(zip(rows.tolist(), columns.tolist(), strict=True)) == expected


def test_patches_of_unlike_size_are_not_compared() -> None:
    scene = Scene(200, 7)
    reference, _ = scene.seen_from(SE3.identity())
    live, _ = scene.seen_from(REFERENCE_FROM_LIVE)
    live.landmarks.octaves[:] = 3
    rows, _ = _core.match_rows(features(reference), features(live), core_settings(CONFIG))
    assert len(rows) < 10  # but for points whose depth is in great doubt


def test_same_input_same_bits_on_every_instruction_set() -> None:
    code = """
import hashlib, sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from tests.scenes import Scene
from engram import _core
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry.se3 import SE3
digest = hashlib.sha256()
for seed in range(4):
    scene = Scene(400, seed)
    a, _ = scene.seen_from(SE3.identity())
    b, _ = scene.seen_from(SE3.exp([0.2, 0, 1, 0, 0.1, 0]), outliers=0.6)
    m = match_frames(a, b, MatcherConfig(), seed)
    for part in (m.reference_from_live.matrix(), m.covariance, m.reference_rows, m.live_rows):
        digest.update(np.ascontiguousarray(part).tobytes())
print(digest.hexdigest())
"""
    assert len(printed(code)) == 1


def test_two_kinds_of_descriptor_are_a_clear_error() -> None:
    frame, _ = Scene(50, 1).seen_from(SE3.identity())
    other = dataclasses.replace(frame, descriptor=TEBLID)
    with pytest.raises(IncompatibleError, match="teblid"):
        match_frames(frame, other, CONFIG, 0)


def test_a_prediction_needs_its_covariance() -> None:
    frame, _ = Scene(50, 1).seen_from(SE3.identity())
    with pytest.raises(InputError, match="covariance"):
        match_frames(frame, frame, CONFIG, 0, predicted=SE3.identity())


@pytest.mark.parametrize(
    "setting", [{"ratio": 1.5}, {"min_consensus": 3}, {"chi2": 0.0}, {"max_distance": -1}]
)
def test_senseless_settings_are_refused(setting: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(setting))):
        MatcherConfig(**setting)


def test_kernels_refuse_arrays_that_do_not_fit() -> None:
    marks = Scene(50, 1).seen_from(SE3.identity())[0].landmarks
    camera = (300.0, 300.0, 255.0, 190.0, 0.3)
    good = [
        marks.pixels,
        marks.disparity_px,
        marks.disparity_sigma_px,
        marks.points_in_cam,
        marks.descriptors,
        marks.octaves,
    ]
    for i in range(len(good)):
        bad = list(good)
        bad[i] = bad[i][:-1]
        with pytest.raises(ValueError, match="one row each"):
            _core.Features(*bad, camera)
    frame = _core.Features(*good, camera)
    for rows in ([50], [-1]):
        index = np.array(rows, np.int32)
        with pytest.raises(IndexError):
            _core.estimate_pose(frame, frame, index, index, core_settings(CONFIG), 0)


def test_hash_and_seed_follow_their_inputs() -> None:
    assert matcher_hash(CONFIG) == matcher_hash(MatcherConfig())
    assert matcher_hash(CONFIG) != matcher_hash(MatcherConfig(ratio=0.8))
    a, b = UUID(int=1), UUID(int=2)
    assert pair_seed(a, b) == pair_seed(UUID(int=1), UUID(int=2))
    assert len({pair_seed(a, b), pair_seed(b, a), pair_seed(a, a)}) == 3
    assert 0 <= pair_seed(a, b) < 2**64


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_a_glance_at_a_part_of_the_landmarks_gives_what_all_of_them_give(outliers: float) -> None:
    all_at_once = dataclasses.replace(CONFIG, glance_share=1)
    for seed in range(5):
        scene = Scene(800, seed)
        reference, _ = scene.seen_from(SE3.identity())
        live, _ = scene.seen_from(REFERENCE_FROM_LIVE, outliers=outliers)
        glanced, whole = (match_frames(reference, live, one, seed) for one in (CONFIG, all_at_once))
        assert glanced.reference_from_live is not None
        assert whole.reference_from_live is not None
        error = glanced.reference_from_live @ whole.reference_from_live.inverse()
        assert error.distance_m < 0.02
        assert abs(glanced.inliers - whole.inliers) < 0.05 * whole.inliers
        assert (np.diff(glanced.reference_rows) > 0).all()


def test_where_a_glance_does_not_suffice_nothing_changes() -> None:
    never = dataclasses.replace(CONFIG, glance_inliers=10_000)
    all_at_once = dataclasses.replace(CONFIG, glance_share=1)
    for seed in range(5):
        scene = Scene(400, seed)
        reference, _ = scene.seen_from(SE3.identity())
        live, _ = scene.seen_from(REFERENCE_FROM_LIVE, outliers=0.5)
        glanced, whole = (match_frames(reference, live, one, seed) for one in (never, all_at_once))
        assert glanced.reference_from_live is not None
        assert whole.reference_from_live is not None
        np.testing.assert_array_equal(
            glanced.reference_from_live.matrix(), whole.reference_from_live.matrix()
        )
        np.testing.assert_array_equal(glanced.live_rows, whole.live_rows)
