"""The contract of feature kinds: every kind goes all the way from images to a map and back.

The kind `both`, BRIEF and the network side by side in 512 bits, stands for kinds of other widths.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.core.textures import texture
from tests.opencv import needs_contrib
from typer.testing import CliRunner

from engram import _core
from engram.cli.app import app
from engram.config import config_hash
from engram.errors import ConfigError, IncompatibleError, MapCorruptError
from engram.frontend import features as network
from engram.frontend.blobs import decode_landmarks, encode_landmarks
from engram.frontend.features import (
    FEATURES,
    NET,
    FeatureKind,
    describe_brief,
    describe_net,
    detect_corners,
    feature_kind,
    fitted_matcher,
    known_kinds,
)
from engram.frontend.frame import BRIEF, DescriptorKind, Frame, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry.cameras import StereoCamera
from engram.maps.map import Map
from engram.places.vocabulary import (
    TrainingConfig,
    decode_vocabulary,
    default_vocabulary,
    encode_vocabulary,
    train_vocabulary,
)
from engram.robot.mapping import extract_log
from engram.robot.settings import Settings
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.opening import open_drive
from engram.testing.contracts import check_kind, unmet
from engram_lab.teblid import TEBLID

CAMERA = StereoCamera(260.0, 260.0, 160.0, 120.0, 0.2, 320, 240)
BOTH = DescriptorKind("both")
STEP_PX = 12  # of the picture, from frame to frame
DISPARITY_PX = 12
FRAMES = 6
STEP_M = CAMERA.baseline_m * STEP_PX / DISPARITY_PX
KINDS = (
    *(
        pytest.param(kind.name, marks=[needs_contrib] if kind.name == TEBLID else [])
        for kind in known_kinds()
    ),
    BOTH,
)


def describe_both(image: np.ndarray, pixels: np.ndarray, octaves: np.ndarray) -> np.ndarray:
    return np.hstack([f(image, pixels, octaves) for f in (describe_brief, describe_net)])


@pytest.fixture(autouse=True)
def _a_kind_of_512_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    matcher = MatcherConfig(max_distance=160, max_guided_distance=180)
    kind = FeatureKind(BOTH, 64, detect_corners, describe_both, matcher)
    monkeypatch.setitem(FEATURES, BOTH, kind)


def wall() -> np.ndarray:
    """A picture of a wall, wide enough for a drive along it."""
    return texture(240, 320 + DISPARITY_PX + STEP_PX * (FRAMES + 2), seed=5)


def pair(index: int, stamp_ns: int, noise: int = 0) -> StereoPair:
    """What a camera sees that drives along the wall."""
    rng = np.random.default_rng([noise, index])
    views = []
    for start in (STEP_PX * index, STEP_PX * index + DISPARITY_PX):
        view = wall()[:, start : start + 320] + rng.normal(0, 3 if noise else 0, (240, 320))
        views.append(np.ascontiguousarray(np.clip(np.rint(view), 0, 255).astype(np.uint8)))
    return StereoPair(stamp_ns, views[0], views[1], CAMERA)


def frame(kind: DescriptorKind, index: int = 0, noise: int = 0) -> Frame:
    return Frontend(FrontendConfig(descriptor=kind)).extract(pair(index, index, noise))


def write_drive(path: Path, noise: int) -> Path:
    for side in ("left", "right"):
        (path / side).mkdir(parents=True)
    for index in range(FRAMES):
        seen = pair(index, 0, noise)
        for side, image in (("left", seen.left), ("right", seen.right)):
            cv2.imwrite(str(path / side / f"{index:03d}.png"), image)
    (path / "times.txt").write_text("".join(f"{noise + index / 10}\n" for index in range(FRAMES)))
    (path / "calibration.toml").write_text(
        "[rectified]\nfx = 260.0\nfy = 260.0\ncx = 160.0\ncy = 120.0\n"
        "baseline_m = 0.2\nwidth = 320\nheight = 240\n"
    )
    return path


def run(*arguments: object) -> dict:
    result = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.mark.parametrize("kind", KINDS)
def test_extraction_gives_descriptors_of_the_width_in_the_table(kind: DescriptorKind) -> None:
    found = frame(kind)
    assert found.descriptor == kind
    landmarks = found.landmarks
    assert landmarks.descriptors.shape == (len(landmarks), feature_kind(kind).descriptor_bytes)
    assert landmarks.descriptors.dtype == np.uint8
    described = feature_kind(kind).describe(pair(0, 0).left, landmarks.pixels, landmarks.octaves)
    # Pixels are stored in steps of 1/64 px: TEBLID, which interpolates, may tell the difference.
    assert np.bitwise_count(described ^ landmarks.descriptors).mean() < 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_frames_match_and_give_the_motion(kind: DescriptorKind) -> None:
    config = fitted_matcher(MatcherConfig(), BRIEF, kind)
    match = match_frames(frame(kind, 0), frame(kind, 1, noise=1), config, seed=1)
    assert match.inliers > 100
    assert match.reference_from_live is not None
    moved = match.reference_from_live.translation
    np.testing.assert_allclose(moved, [STEP_M, 0, 0], atol=0.02)


@pytest.mark.parametrize("kind", KINDS)
def test_landmarks_come_back_from_a_blob(kind: DescriptorKind) -> None:
    landmarks = frame(kind).landmarks
    blob = encode_landmarks(landmarks, CAMERA)
    read = decode_landmarks(blob, CAMERA, kind)
    np.testing.assert_array_equal(read.descriptors, landmarks.descriptors)
    np.testing.assert_array_equal(read.points_in_cam, landmarks.points_in_cam)
    other = BOTH if kind != BOTH else BRIEF
    with pytest.raises(MapCorruptError, match="descriptors is U8"):
        decode_landmarks(blob, CAMERA, other)


@pytest.mark.parametrize("kind", KINDS)
def test_a_drive_is_mapped_and_another_is_localised_in_it(
    kind: DescriptorKind, tmp_path: Path
) -> None:
    city = tmp_path / "city.engram"
    mapped = run("map", city, write_drive(tmp_path / "a", 1), "--features", kind)
    assert mapped["nodes_saved"] >= 2
    with Map.open(city) as store:
        assert store.descriptor == kind
    assert run("check", city)["problems"] == []
    found = run("localise", city, write_drive(tmp_path / "b", 2))
    assert found["summary"]["share_localised"] == 1.0


@pytest.mark.parametrize("kind", KINDS)
def test_a_frame_log_keeps_what_was_extracted(kind: DescriptorKind, tmp_path: Path) -> None:
    sequence = open_drive(write_drive(tmp_path / "a", 1))
    out = tmp_path / "a.framelog"
    settings = Settings().for_descriptor(kind)
    extract_log(sequence, out, settings)
    log = open_drive(out)
    assert isinstance(log, FrameLog)
    for live, logged in zip(sequence, log, strict=True):
        expected = Frontend(settings.frontend).extract(live)
        assert logged.frame.descriptor == kind
        np.testing.assert_array_equal(
            logged.frame.landmarks.descriptors, expected.landmarks.descriptors
        )


@pytest.mark.parametrize("kind", KINDS)
def test_a_vocabulary_is_trained_kept_and_used(kind: DescriptorKind) -> None:
    frames = [frame(kind, index).landmarks.descriptors for index in range(FRAMES)]
    vocabulary = train_vocabulary(frames, kind, TrainingConfig(words=50, depth=2, samples=2))
    read = decode_vocabulary(encode_vocabulary(vocabulary))
    assert read.descriptor == kind
    np.testing.assert_array_equal(
        read.words_of(frames[0], kind), vocabulary.words_of(frames[0], kind)
    )
    assert len(read.words_of(frames[0], kind)) > 10


def test_a_kind_without_a_vocabulary_of_its_own_has_one_of_a_single_word() -> None:
    vocabulary = default_vocabulary(BOTH)
    assert vocabulary.words_of(frame(BOTH).landmarks.descriptors, BOTH).tolist() == [0]


def test_kinds_are_never_compared_with_each_other() -> None:
    with pytest.raises(IncompatibleError, match="both"):
        match_frames(frame(BRIEF), frame(BOTH), MatcherConfig(), seed=0)


@pytest.mark.parametrize("words", [1, 3, 4, 5, 8, 256])
def test_distances_are_counted_at_any_width(words: int) -> None:
    rng = np.random.default_rng(words)
    a = rng.integers(0, 256, (7, 8 * words), dtype=np.uint8)
    b = rng.integers(0, 256, (5, 8 * words), dtype=np.uint8)
    expected = np.bitwise_count(a[:, None] ^ b[None]).sum(axis=2)
    np.testing.assert_array_equal(_core.hamming_matrix(a, b), expected)


@pytest.mark.parametrize("size", [0, 7, 33, 2056])
def test_widths_that_are_no_whole_words_are_refused(size: int) -> None:
    odd = np.zeros((2, size), np.uint8)
    with pytest.raises(ValueError, match="8, 16, 24"):
        _core.hamming_matrix(odd, odd)
    with pytest.raises(IncompatibleError, match="multiple of 8"):
        FeatureKind(BOTH, size, detect_corners, describe_both)


def test_descriptors_of_different_widths_are_refused() -> None:
    with pytest.raises(ValueError, match="different widths"):
        _core.hamming_matrix(np.zeros((2, 32), np.uint8), np.zeros((2, 64), np.uint8))


def test_twice_the_same_bits_match_as_once() -> None:
    """A kind that says everything twice, at twice the distances, finds the same pairs."""
    once = [frame(BRIEF, 0), frame(BRIEF, 1, noise=1)]
    config = MatcherConfig()
    doubled = MatcherConfig(max_distance=160, max_guided_distance=180)

    def features(one: Frame, times: int) -> _core.Features:
        marks = one.landmarks
        return _core.Features(
            marks.pixels,
            marks.disparity_px,
            marks.disparity_sigma_px,
            marks.points_in_cam,
            np.tile(marks.descriptors, (1, times)),
            marks.octaves,
            (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, CAMERA.baseline_m),
        )

    from engram.frontend.matching import core_settings

    one, two = (
        _core.attempt(features(once[1], by), [(features(once[0], by), settings, 3, None, None)])[0]
        for by, settings in ((1, core_settings(config)), (2, core_settings(doubled)))
    )
    assert one is not None
    assert two is not None
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)


def test_settings_of_matching_follow_the_kind_unless_they_are_set() -> None:
    settings = Settings().for_descriptor(BOTH)
    assert settings.localiser.matcher.max_distance == 160
    assert settings.odometry.matcher.max_guided_distance == 180
    assert settings.for_descriptor(BRIEF) == Settings()
    strict = MatcherConfig(max_distance=60)
    assert fitted_matcher(strict, BRIEF, BOTH).max_distance == 60


def test_the_table_leaves_the_hashes_of_the_first_kinds_as_they_were() -> None:
    assert config_hash(Settings().for_descriptor(TEBLID).localiser) == config_hash(
        Settings().localiser
    )


def test_an_unknown_kind_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"'orb' .*both, brief, net, teblid"):
        FrontendConfig(descriptor=DescriptorKind("orb"))


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_meets_the_contract(kind: DescriptorKind) -> None:
    assert unmet(check_kind(feature_kind(kind))) == []


def test_a_kind_that_breaks_the_contract_is_found_out() -> None:
    def nothing(image: np.ndarray, pixels: np.ndarray, octaves: np.ndarray) -> np.ndarray:
        return np.zeros((len(pixels), 64), np.uint8)

    broken = FeatureKind(BOTH, 64, detect_corners, nothing)
    FEATURES[BOTH] = broken
    assert [one.split()[0] for one in unmet(check_kind(broken))] == ["different", "100"]


def test_a_learned_kind_is_named_with_its_model_and_found_without_it() -> None:
    assert feature_kind("net").name == NET == f"net@{network.MODEL}"
    assert FrontendConfig(descriptor=DescriptorKind("net")).descriptor == NET
    assert Settings().for_descriptor(DescriptorKind("net")).frontend.descriptor == NET


def test_another_model_is_refused_with_the_command_that_helps(tmp_path: Path) -> None:
    with pytest.raises(IncompatibleError, match=r"of model 12345678.*engram record --features net"):
        feature_kind("net@12345678")
    with pytest.raises(IncompatibleError, match=r"brief are of model 1234.*has brief"):
        feature_kind("brief@1234")


def test_weights_of_another_model_are_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network, "MODEL", "12345678")
    with pytest.raises(IncompatibleError, match="must be 12345678; install Engram again"):
        network.weights()


def test_the_verb_lists_and_checks_kinds() -> None:
    listed = run("features", "list")
    good_at = "night, snow, low sun, other seasons"
    assert {"kind": NET, "bits": 256, "good_at": good_at} in listed["kinds"]
    assert all(met for _, met, _ in run("features", "check", "net")["checks"][NET])
    ran = CliRunner().invoke(app, ["features", "check", "orb"])
    assert isinstance(ran.exception, IncompatibleError)
