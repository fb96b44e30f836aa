"""Landmarks survive being stored without the loss of a bit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from engram.errors import InputError
from engram.frontend.blobs import (
    SIGMA_TABLE_PX,
    LandmarkCodes,
    dequantise,
    landmarks_from_codes,
    pixel_quantum,
    quantise,
    quantised_landmarks,
)
from engram.geometry.cameras import StereoCamera

sizes = st.integers(1, 65535)


@st.composite
def all_codes(draw: st.DrawFn) -> LandmarkCodes:
    count = draw(st.integers(0, 20))
    return LandmarkCodes(
        draw(arrays(np.uint16, (count, 2))),
        draw(arrays(np.uint16, count, elements=st.integers(1, 65535))),
        draw(arrays(np.uint8, count)),
    )


@given(all_codes(), sizes)
def test_codes_survive_the_way_through_floats(codes: LandmarkCodes, width: int) -> None:
    quantum = pixel_quantum(width)
    again = quantise(*dequantise(codes, quantum), quantum)
    np.testing.assert_array_equal(again.pixels, codes.pixels)
    np.testing.assert_array_equal(again.disparity, codes.disparity)
    np.testing.assert_array_equal(again.sigma, codes.sigma)


@given(
    arrays(np.float32, (9, 2), elements=st.floats(0, 511, width=32)),
    arrays(np.float32, 9, elements=st.floats(0.015625, 500, width=32)),
    arrays(np.float32, 9, elements=st.floats(0.015625, 3.5, width=32)),
)
def test_rounding_errs_by_half_a_quantum_at_most(pixels, disparity, sigma) -> None:
    quantum = pixel_quantum(512, 384)
    stored = dequantise(quantise(pixels, disparity, sigma, quantum), quantum)
    assert np.abs(stored[0] - pixels).max() <= quantum / 2
    assert np.abs(stored[1] - disparity).max() <= quantum / 2
    # Half a logarithmic step is 2^(1/64): 1.1 %; the rest is the rounding of float32.
    assert np.abs(np.log2(stored[2] / sigma)).max() <= 1 / 64 + 1e-6


@given(
    arrays(np.float32, (9, 2), elements=st.floats(-1, 1100, width=32)),
    arrays(np.float32, 9, elements=st.floats(-1, 1100, width=32)),
    arrays(np.float32, 9, elements=st.floats(0, 8, width=32)),
)
def test_one_call_gives_the_same_landmarks_to_the_bit(pixels, disparity, sigma) -> None:
    camera = StereoCamera(301.7, 299.3, 255.1, 190.7, 0.31, 512, 384)
    descriptors, octaves = np.zeros((9, 32), np.uint8), np.zeros(9, np.uint8)
    try:
        codes = quantise(pixels, disparity, sigma, pixel_quantum(512, 384))
    except InputError:
        with pytest.raises(InputError):
            quantised_landmarks(pixels, disparity, sigma, descriptors, octaves, camera)
        return
    expected = landmarks_from_codes(codes, descriptors, octaves, camera)
    found = quantised_landmarks(pixels, disparity, sigma, descriptors, octaves, camera)
    for name in ("pixels", "disparity_px", "disparity_sigma_px", "points_in_cam"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


@given(sizes, sizes)
def test_quantum_is_the_finest_that_fits(width: int, height: int) -> None:
    quantum = pixel_quantum(width, height)
    side = max(width, height)
    assert side / quantum <= 65535
    assert quantum == 1 / 64 or 2 * side / quantum > 65535


@pytest.mark.parametrize(("width", "quantum"), [(512, 1 / 64), (1023, 1 / 64), (1242, 1 / 32)])
def test_quantum_of_known_cameras(width: int, quantum: float) -> None:
    assert pixel_quantum(width) == quantum


def test_a_disparity_near_zero_stays_positive() -> None:
    codes = quantise(
        np.zeros((1, 2), np.float32),
        np.array([1e-6], np.float32),
        np.array([1e-9], np.float32),
        pixel_quantum(512),
    )
    assert codes.disparity[0] == 1
    assert codes.sigma[0] == 0


@pytest.mark.parametrize("bad", [-1.0, 1e6, np.nan, np.inf])
def test_what_does_not_fit_is_refused(bad: float) -> None:
    good = np.ones(1, np.float32)
    with pytest.raises(InputError, match="pixel lies outside"):
        quantise(np.full((1, 2), bad, np.float32), good, good, 1 / 64)


@pytest.mark.parametrize("size", [(0, 5), (5, 0), (65536, 1)])
def test_impossible_image_sizes_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(InputError, match="image size"):
        pixel_quantum(*size)


def test_sigma_codes_rise_by_equal_factors() -> None:
    np.testing.assert_allclose(SIGMA_TABLE_PX[1:] / SIGMA_TABLE_PX[:-1], 2 ** (1 / 32), rtol=1e-6)


def test_landmarks_are_built_from_codes() -> None:
    camera = StereoCamera(100.0, 100.0, 50.0, 40.0, 0.5, 101, 81)
    codes = LandmarkCodes(
        np.array([[60 * 64, 40 * 64]], np.uint16),
        np.array([5 * 64], np.uint16),
        np.array([64], np.uint8),
    )
    octaves = np.zeros(1, np.uint8)
    landmarks = landmarks_from_codes(codes, np.zeros((1, 32), np.uint8), octaves, camera)
    np.testing.assert_array_equal(landmarks.points_in_cam, [[1.0, 0.0, 10.0]])  # z = 100·0.5/5
    assert landmarks.disparity_sigma_px[0] == np.float32(2.0**-4)
