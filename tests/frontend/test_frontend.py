"""The front-end: what its frames hold, and what it says of images that are of no use."""

import dataclasses

import cv2
import numpy as np
import pytest
from tests.core.textures import shifted_pair
from tests.opencv import needs_contrib

from engram.config import from_dict, to_dict
from engram.errors import ConfigError, SequenceError
from engram.frontend.blobs import pixel_quantum, quantise
from engram.frontend.features import describe_brief, feature_kind
from engram.frontend.frame import BRIEF, DescriptorKind, FrameStatus, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig, make_thumbnail
from engram.geometry.cameras import StereoCamera
from engram_lab.teblid import TEBLID

CAMERA = StereoCamera(260.0, 260.0, 160.0, 120.0, 0.2, 320, 240)
LEFT, RIGHT = shifted_pair(240, 320, 12.25, seed=1, noise=2.0)
# Threshold and number of landmarks of a frame of no use.
NOISE = np.random.default_rng(2).normal(0, 1.5, LEFT.shape)


def pair(left: np.ndarray = LEFT, right: np.ndarray = RIGHT) -> StereoPair:
    return StereoPair(1_000, left, right, CAMERA)


def grey(level: float) -> np.ndarray:
    return np.clip(np.rint(level + NOISE), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("kind", [BRIEF, pytest.param(TEBLID, marks=needs_contrib)])
def test_landmarks_lie_where_the_plane_is(kind: DescriptorKind) -> None:
    frontend = Frontend(FrontendConfig(descriptor=kind))
    frame = frontend.extract(pair())
    landmarks = frame.landmarks
    assert frame.status is FrameStatus.OK
    assert (frame.descriptor, frame.frontend, frame.stamp_ns) == (kind, frontend.hash, 1_000)
    assert 200 < len(landmarks) <= 345  # 600 · (320·240 / (512·384))^0.6
    assert set(landmarks.octaves) == {0, 1}
    depth_m = CAMERA.focal_baseline / 12.25
    # 0.02 px of pull towards whole pixels in 12 px
    np.testing.assert_allclose(np.median(landmarks.points_in_cam[:, 2]), depth_m, rtol=0.002)
    assert landmarks.descriptors.shape == (len(landmarks), 32)
    assert len(np.unique(landmarks.descriptors, axis=0)) > 0.9 * len(landmarks)


def test_frames_survive_storage_unchanged() -> None:
    landmarks = Frontend().extract(pair()).landmarks
    quantum = pixel_quantum(CAMERA.width, CAMERA.height)
    codes = quantise(
        landmarks.pixels, landmarks.disparity_px, landmarks.disparity_sigma_px, quantum
    )
    np.testing.assert_array_equal(codes.pixels * np.float32(quantum), landmarks.pixels)
    np.testing.assert_array_equal(codes.disparity * np.float32(quantum), landmarks.disparity_px)


def test_the_fused_descriptors_are_those_of_the_table() -> None:
    landmarks = Frontend().extract(pair()).landmarks
    expected = describe_brief(LEFT, landmarks.pixels, landmarks.octaves)
    np.testing.assert_array_equal(landmarks.descriptors, expected)


@pytest.mark.parametrize("kind", [BRIEF, TEBLID])
def test_describing_nothing_gives_nothing(kind: DescriptorKind) -> None:
    nothing = feature_kind(kind).describe(LEFT, np.empty((0, 2), np.float32), np.empty(0, np.uint8))
    assert nothing.shape == (0, 32)


def test_low_contrast_still_gives_landmarks() -> None:
    faint = [
        (20 + (image.astype(float) - 128) * 0.2).clip(0).astype(np.uint8) for image in (LEFT, RIGHT)
    ]
    frame = Frontend().extract(pair(*faint))
    assert frame.status is FrameStatus.OK
    assert len(frame.landmarks) > 100


@pytest.mark.parametrize(
    ("left", "right", "status"),
    [
        (grey(5), grey(5), FrameStatus.DARK),
        (np.zeros_like(LEFT), np.zeros_like(LEFT), FrameStatus.DARK),
        (grey(90), grey(90), FrameStatus.COVERED),
        (np.full_like(LEFT, 255), np.full_like(LEFT, 255), FrameStatus.COVERED),
        (cv2.GaussianBlur(LEFT, (0, 0), 15), RIGHT, FrameStatus.COVERED),
        (LEFT, grey(90), FrameStatus.COVERED),
        (LEFT, np.zeros_like(LEFT), FrameStatus.DARK),
        (LEFT, np.ascontiguousarray(RIGHT[::-1]), FrameStatus.TOO_FEW_LANDMARKS),
    ],
    ids=[
        "dark",
        "black",
        "covered",
        "white",
        "left-unfocused",
        "right-covered",
        "right-black",
        "mismatch",
    ],
)
def test_useless_images_are_named_and_never_an_error(left, right, status) -> None:
    assert Frontend().extract(pair(left, right)).status is status


def test_a_darker_side_gives_as_many_landmarks_and_another_hash_than_without() -> None:
    dark = pair(right=(0.35 * RIGHT).astype(np.uint8))
    as_they_are = Frontend(FrontendConfig(side_difference=0))
    usual = len(as_they_are.extract(pair()).landmarks)
    assert len(as_they_are.extract(dark).landmarks) < 0.5 * usual
    assert len(Frontend().extract(dark).landmarks) > 0.97 * usual
    assert Frontend().hash != as_they_are.hash


def test_a_body_in_the_picture_does_not_change_how_sides_are_compared() -> None:
    mask = np.ones(LEFT.shape, np.bool_)
    mask[LEFT.shape[0] // 2 :] = False
    masked = dataclasses.replace(pair(), mask=mask)
    frames = [
        Frontend(FrontendConfig(side_difference=limit)).extract(masked) for limit in (0, 0.25)
    ]
    assert len(frames[0].landmarks) > 50
    np.testing.assert_array_equal(*(one.landmarks.disparity_px for one in frames))


def test_hash_names_version_and_settings() -> None:
    config = FrontendConfig(landmarks=500)
    assert Frontend(config).hash == Frontend(dataclasses.replace(config)).hash
    assert Frontend(config).hash != Frontend().hash
    assert len(Frontend().hash) == 12


def test_settings_survive_plain_values_and_are_checked() -> None:
    config = FrontendConfig(descriptor=TEBLID)
    assert from_dict(to_dict(config), FrontendConfig) == config
    with pytest.raises(ConfigError, match="frontend: octaves is 9, must be >= 1 and <= 4"):
        FrontendConfig(octaves=9)


def test_images_that_do_not_fit_the_camera_are_refused() -> None:
    with pytest.raises(SequenceError, match=r"left image at 1000 ns is uint8 \(100, 320\)"):
        Frontend().extract(pair(LEFT[:100]))
    with pytest.raises(SequenceError, match="float32"):
        Frontend().extract(pair(LEFT, RIGHT.astype(np.float32)))


@pytest.mark.parametrize(("width", "expected"), [(512, 128), (1242, 155), (160, 160), (97, 97)])
def test_thumbnails_are_at_most_160_px_wide(width: int, expected: int) -> None:
    image = np.full((384, width), 77, np.uint8)
    thumbnail = make_thumbnail(image)
    assert thumbnail.shape[1] == expected
    assert (thumbnail == 77).all()
    assert not np.shares_memory(thumbnail, image)
