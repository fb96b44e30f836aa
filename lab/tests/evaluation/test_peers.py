"""The pipeline of single images against plain oracles, and the table of the study beside it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from tests.builders import forward, synthetic_drive, write_street

from engram.errors import ConfigError
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram_lab.studies import pages, peers
from engram_lab.studies.peers import Answer, Engram, Scene, Sift, TrueDrive, judged, rows_of
from engram_lab.studies.plan import write_csv
from engram_lab.studies.sift_places import (
    Corners,
    SiftMap,
    SiftOptions,
    absolute_pose,
    mutual_matches,
    root_sift,
    stereo_points,
    train_words,
    vlad,
)

needs_pycolmap = pytest.mark.skipif(
    find_spec("pycolmap") is None, reason="pycolmap is not installed: pip install pycolmap"
)
CAMERA = StereoCamera(300.0, 300.0, 160.0, 120.0, 0.25, 320, 240)
STEP_M = 0.8


def unit_rows(seed: int, count: int) -> np.ndarray:
    rows = np.abs(np.random.default_rng(seed).normal(size=(count, 128))).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_vlad_sums_what_descriptors_differ_from_their_nearest_word() -> None:
    descriptors, words = unit_rows(1, 40), 0.9 * unit_rows(2, 5)
    expected = np.zeros((5, 128))
    for one in descriptors:
        word = min(range(5), key=lambda w: float(np.linalg.norm(one - words[w])))
        expected[word] += one - words[word]
    for word in range(5):
        expected[word] /= np.linalg.norm(expected[word]) or 1.0
    expected /= np.linalg.norm(expected)
    np.testing.assert_allclose(vlad(descriptors, words), expected.ravel(), atol=1e-5)


def test_words_are_the_same_every_time_and_lie_among_the_descriptors() -> None:
    descriptors = np.concatenate([unit_rows(3, 1) + 0.001 * unit_rows(k, 1) for k in range(20)])
    descriptors = np.concatenate([descriptors, unit_rows(4, 1).repeat(20, axis=0)])
    words = train_words(descriptors, 2)
    np.testing.assert_array_equal(words, train_words(descriptors, 2))
    assert min(np.linalg.norm(words - unit_rows(4, 1), axis=1)) < 0.01


def test_matches_are_mutual_and_clearer_than_the_second() -> None:
    live, stored = unit_rows(5, 30), np.concatenate([unit_rows(5, 30)[::-1], unit_rows(6, 30)])
    rows, found = mutual_matches(live, stored, 0.85)
    expected = []
    angles = np.arccos(np.clip(live.astype(float) @ stored.T.astype(float), -1, 1))
    for row in range(30):
        first, second = np.argsort(angles[row])[:2]
        mutual = angles[:, first].argmin() == row
        if mutual and angles[row, first] < 0.85 * angles[row, second]:
            expected.append((row, first))
    assert list(zip(rows.tolist(), found.tolist(), strict=True)) == expected
    assert len(expected) == 30
    assert len(mutual_matches(live, stored[:1], 0.85)[0]) == 0


def test_stereo_finds_the_depth_of_corners_in_one_row() -> None:
    descriptors = unit_rows(7, 4)
    left = Corners(np.array([[100, 50], [200, 80], [50, 90], [60, 200]], np.float32), descriptors)
    # The second lies in another row, the third to the right of the left one.
    right = Corners(np.array([[90, 50.5], [190, 85], [55, 90], [45, 200]], np.float32), descriptors)
    rows, points = stereo_points(left, right, CAMERA, SiftOptions())
    assert rows.tolist() == [0, 3]
    np.testing.assert_allclose(points[:, 2], [300 * 0.25 / 10, 300 * 0.25 / 15])
    np.testing.assert_allclose(points[0, :2], [(100 - 160) / 300 * 7.5, (50 - 120) / 300 * 7.5])


@needs_pycolmap
def test_the_pose_of_synthetic_points_is_found_among_wrong_ones() -> None:
    rng = np.random.default_rng(8)
    world_from_cam = SE3.exp([0.5, -0.2, 1.0, 0.05, 0.3, -0.02])
    in_cam = np.column_stack([rng.uniform(-2, 2, (60, 2)), rng.uniform(4, 12, 60)])
    pixels = in_cam[:, :2] / in_cam[:, 2:] * 300 + (160, 120)
    points = world_from_cam @ in_cam
    points[:20] += rng.uniform(2, 5, (20, 3))
    found = absolute_pose(pixels, points, CAMERA, 2.0)
    assert found is not None
    pose, inliers = found
    assert inliers == 40
    assert (world_from_cam.inverse() @ pose).distance_m < 1e-6
    assert absolute_pose(pixels[:3], points[:3], CAMERA, 2.0) is None


def test_an_image_without_corners_has_none() -> None:
    found = root_sift(np.zeros((240, 320), np.uint8), SiftOptions())
    assert found.pixels.shape == (0, 2)
    assert found.descriptors.shape == (0, 128)
    assert len(stereo_points(found, found, CAMERA, SiftOptions())[0]) == 0


@needs_pycolmap
def test_images_between_those_of_a_map_are_localised_and_a_map_reads_as_written(
    tmp_path: Path,
) -> None:
    pairs = synthetic_drive(frames=6, step_m=STEP_M)
    poses = [forward(STEP_M * number) for number in range(6)]
    made = SiftMap.of(list(zip(pairs, poses, strict=True))[::2], SiftOptions(words=8))
    made.save(tmp_path / "map.npz")
    for number in (1, 3):
        for places in (made, SiftMap.load(tmp_path / "map.npz")):
            found = places.localise(pairs[number])
            assert found is not None
            assert found[1] > 30
            assert (poses[number].inverse() @ found[0]).distance_m < 0.05
    dark = replace(pairs[1], left=np.zeros_like(pairs[1].left))
    assert made.localise(dark) is None


def answer(at_m: float, error_m: float | None = None, inliers: int = 50) -> Answer:
    return Answer(at_m, error_m, None if error_m is None else 0.01, inliers, 2.0)


def test_a_drive_is_judged_by_its_fixes_and_what_lies_between_them() -> None:
    answers = [answer(0.0, 0.01), answer(5.0), answer(12.0, 2.0), answer(20.0, 0.03, 10)]
    found = judged(answers)
    assert (found["frames"], found["localised"], found["false"]) == (4, 3, 1)
    assert found["gap_share"] == pytest.approx(12 / 20)
    assert found["median_cm"] == pytest.approx(3.0)
    assert judged(answers, least_inliers=15)["localised"] == 2
    nothing = judged([answer(0.0), answer(40.0)])
    assert (nothing["localised"], nothing["gap_share"], nothing["median_cm"]) == (0, 1.0, "")


@pytest.fixture
def street(tmp_path: Path) -> Scene:
    path = write_street(tmp_path / "street", frames=8)
    whole = TrueDrive("", path, {}, {}).open().stamps_ns.tolist()
    truth = {stamp_ns: forward(STEP_M * number) for number, stamp_ns in enumerate(whole)}
    even, odd = (TrueDrive("odd", path, {"frames": f"{k}::2"}, truth) for k in (0, 1))
    return Scene("street", (even,), (odd,))


def test_engram_is_judged_in_its_nodes_and_what_is_done_is_not_done_again(
    street: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (row,) = rows_of(Engram("brief"), street, tmp_path)
    assert (row["frames"], row["false"]) == (4, 0)
    assert row["localised"] >= 3
    assert row["median_cm"] < 5

    def again(*_: object) -> Iterator[Answer]:
        raise AssertionError("asked again")

    monkeypatch.setattr(Engram, "answers", again)
    assert list(rows_of(Engram("brief"), street, tmp_path)) == [row]


@needs_pycolmap
def test_the_pipeline_has_a_row_for_each_least_number_of_inliers(
    street: Scene, tmp_path: Path
) -> None:
    rows = list(rows_of(Sift(), street, tmp_path))
    assert [one["system"].split()[-2] for one in rows] == ["15", "30"]
    assert {one["false"] for one in rows} == {0}
    assert rows[0]["localised"] == 4


def test_the_village_has_five_drives_to_map_and_five_to_judge() -> None:
    village = peers.small_village()
    assert len(village.sessions) == 10
    assert {one.robot for one in village.sessions} == {"wildcat"}
    starts = [one.start for one in village.sessions]
    assert max(starts[:5]) < min(starts[5:])


def test_results_of_another_version_are_refused(tmp_path: Path) -> None:
    peers._check_version(tmp_path / "configuration.json", 1)
    peers._check_version(tmp_path / "configuration.json", 1)
    with pytest.raises(ConfigError, match=r"seed 1, this run is of .* seed 2; give another --out"):
        peers._check_version(tmp_path / "configuration.json", 2)


def test_pages_draw_the_town_and_the_clips(tmp_path: Path) -> None:
    figures = judged([answer(0.0, 0.01), answer(5.0), answer(20.0, 2.0)])
    rows = [
        {"system": "A", "scene": scene, "drive": drive, "map_mb": 3.2, **figures}
        for scene, drive in (
            ("village", "fair"), ("village", "snow"), ("village, two drives", "fair"),
            ("KITTI 06", "odd"), ("EuRoC V1_01", "late"),
        )
    ]  # fmt: skip
    (tmp_path / "peers").mkdir()
    write_csv(tmp_path / "peers/peers.csv", rows)
    head, _, of_five, of_two = pages.peers(tmp_path)
    assert head.startswith("| localised, % | mapped | fair | snow | false")
    assert of_five == "| A | 5 | 67 | 67 | 2 of 4 | 100 | 100.5 | 2 | 3 |"
    assert of_two == "| A | 2 | 67 | 1 of 2 | 100 | 100.5 | 2 | 3 |"
    head, _, of_clips = pages.peers_on_clips(tmp_path)
    assert head.startswith("| | KITTI 06 | false | error, cm | CPU, ms | MB | EuRoC V1_01 | ")
    assert of_clips == "| A | 2 of 3 | 1 | 100.5 | 2 | 3.2 | 2 of 3 | 1 | 100.5 | 2 | 3.2 |"
