"""The matchers that judge the town, and the table of their answers."""

from __future__ import annotations

import os
import pickle
import zipfile
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.core.textures import shifted_pair

from engram.errors import ConfigError
from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram_lab.roads.clips import load_clip, noise_of, spectrum_of
from engram_lab.roads.matching import Answer, Answers, Mapped, distinct, resected
from engram_lab.roads.odometry import motion, tracked
from engram_lab.roads.seasons import shares
from engram_lab.roads.xfeat import _convolved, mutual, read_weights
from engram_lab.town.drive import robot_named
from engram_lab.town.rendering import Visit, at

_VISIT = Visit("rain", at(7, 15, 11.0), "rain", 15)


def unit_rows(count: int, seed: int) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(count, 16)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@given(st.integers(0, 12), st.integers(0, 12), st.integers(0, 1000))
def test_distinct_and_mutual_matches_are_those_of_a_plain_search(one, other, seed):
    words, others = unit_rows(one, seed), unit_rows(other, seed + 1)
    apart = np.linalg.norm(words[:, None] - others[None], axis=2).reshape(one, other)
    wanted, near = [], []
    for k, row in enumerate(apart):
        order = np.argsort(row)
        if other >= 2 and row[order[0]] < 0.8 * row[order[1]]:
            wanted.append((k, order[0]))
        if other and k == np.argmin(apart[:, order[0]]) and row[order[0]] ** 2 < 2 * (1 - 0.82):
            near.append((k, order[0]))
    assert [tuple(pair) for pair in distinct(words, others, 0.8)] == wanted
    assert [tuple(pair) for pair in mutual(words, others)] == near


def test_a_convolution_is_that_of_opencv():
    rng = np.random.default_rng(2)
    image = rng.normal(size=(12, 10, 3)).astype(np.float32)
    weights = rng.normal(size=(2, 3, 3, 3)).astype(np.float32)
    for stride in (1, 2):
        found = _convolved(image, weights, stride)
        for k in range(2):
            wanted = sum(
                cv2.filter2D(image[:, :, c], -1, weights[k, c], borderType=cv2.BORDER_CONSTANT)
                for c in range(3)
            )
            np.testing.assert_allclose(found[:, :, k], wanted[::stride, ::stride], atol=1e-5)


class _Hostile:
    def __reduce__(self):
        return os.getcwd, ()


def test_a_file_of_weights_can_execute_nothing(tmp_path: Path):
    file = tmp_path / "xfeat.pt"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps(_Hostile(), 2))
    with pytest.raises(ConfigError, match=r"names posix.getcwd, not a tensor"):
        read_weights(file)
    file.write_bytes(b"none")
    with pytest.raises(ConfigError, match="holds no weights"):
        read_weights(file)


def test_a_pose_is_found_among_wrong_matches():
    camera, rng = robot_named("wildcat").camera, np.random.default_rng(5)
    truth = SE3.exp(np.array([0.3, -0.1, 0.5, 0.02, 0.05, -0.01]))
    points = rng.uniform([-4, -2, 5], [4, 2, 30], (60, 3))
    seen = truth @ points
    pixels = seen[:, :2] / seen[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    pixels[:20] += rng.uniform(30, 90, (20, 2))
    found = resected(points, pixels, camera)
    assert found is not None
    assert (found[0].inverse() @ truth).distance_m < 1e-4
    assert not found[1][:20].any()
    assert found[1][20:].all()


def test_tracking_gives_up_what_does_not_come_back():
    rng = np.random.default_rng(1)
    image = cv2.GaussianBlur(rng.uniform(0, 255, (96, 128)).astype(np.uint8), (0, 0), 1.5)
    moved = np.roll(image, 3, axis=1)
    moved[60:] = 128
    pixels = np.array([[40, 30], [80, 40], [60, 80]], dtype=np.float32)
    there, found = tracked(image, moved, pixels, pixels)
    assert found.tolist() == [True, True, False]
    np.testing.assert_allclose((there - pixels)[:2], [[3, 0]] * 2, atol=0.1)


def test_a_camera_at_rest_has_not_moved_and_a_black_one_says_nothing():
    camera = StereoCamera(260.0, 260.0, 160.0, 120.0, 0.2, 320, 240)
    left, right = shifted_pair(240, 320, 12.25, seed=1, noise=2.0)
    pair = StereoPair(1, left, right, camera)
    found = motion(pair, pair, SE3.identity())
    assert found is not None
    assert found.distance_m < 1e-3
    black = StereoPair(2, np.zeros_like(left), np.zeros_like(right), camera)
    assert motion(black, pair, SE3.identity()) is None


def test_shares_are_compared_over_the_same_places():
    near, base = np.arange(40) % 4 > 0, np.arange(40) % 10 > 0
    change, deviation = shares(near, base)
    assert change == pytest.approx(-15)
    paired = 100 * np.std(near.astype(float) - base) / np.sqrt(40)
    assert deviation == pytest.approx(paired, rel=0.1)


def test_noise_and_spectrum_are_those_that_were_made():
    rng = np.random.default_rng(3)
    plane = np.add.outer(np.linspace(60, 120, 256), np.linspace(0, 40, 256))
    noisy = (plane + rng.normal(0, 2.5, plane.shape)).astype(np.float32)
    # The half that looks smoothest holds a little less of it.
    assert noise_of(noisy) == pytest.approx(2.5 * 0.9, rel=0.1)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(256), np.fft.fftfreq(256)))
    frequency[0, 0] = 1
    phases = np.fft.fft2(rng.normal(size=(256, 256)))
    for slope in (-1.0, -1.5):
        image = np.fft.ifft2(phases * frequency**slope).real.astype(np.float32)
        assert spectrum_of(image) == pytest.approx(slope, abs=0.15)


class _Asked(Mapped):
    """Counts how often it is asked."""

    def __init__(self, answers: list[Answer]) -> None:
        self.times, self._given = 0, answers

    def answers(self, visit: Visit) -> list[Answer]:
        self.times += 1
        return self._given


def test_a_run_goes_on_where_it_was_ended(tmp_path: Path):
    table, wanted = tmp_path / "rows.csv", [Answer(30, 0.25, 1.5), Answer(0)]
    mapped = _Asked(wanted)
    for _ in range(2):
        answers = Answers(table, "seasons")
        assert answers.of(4, mapped, _VISIT) == answers.of(4, mapped, _VISIT) == wanted
    assert mapped.times == 1
    assert Answers(table, "midday").of(4, mapped, _VISIT) == wanted
    assert mapped.times == 2
    assert [answer.near for answer in wanted] == [True, False]


def test_a_table_of_other_columns_is_refused(tmp_path: Path):
    table = tmp_path / "rows.csv"
    table.write_text("town,visit\n4,rain\n")
    with pytest.raises(ConfigError, match="has columns"):
        Answers(table, "seasons")


@pytest.mark.data
def test_the_clip_is_kittis(data_dir: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ENGRAM_DATA", str(data_dir))
    clip = load_clip()
    assert len(clip) == 51
    spacing_m = np.mean([(a[0].inverse() @ b[0]).distance_m for a, b in pairwise(clip)])
    assert spacing_m == pytest.approx(1.197, abs=0.001)


def test_a_clip_that_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ENGRAM_DATA", str(tmp_path))
    with pytest.raises(ConfigError, match="must name a folder with"):
        load_clip()
