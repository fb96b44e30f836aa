"""The extraction kernels against their plain NumPy twins."""

import hashlib
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
import pytest
from tests.core.textures import shifted_pair, texture
from tests.instruction_sets import printed
from tests.reference import brief, corners, disparity, sides

from engram import _core

STEREO = {
    "max_disparity_px": 60,
    "min_disparity_px": 0.5,
    "uniqueness": 0.85,
    "max_residual": 0.5,
    "max_sigma_px": 1.0,
    "sigma_floor_px": 0.05,
    "sigma_scale": 1.0,
}
EXTRACT = {"landmarks": 150, "octaves": 2, "fast_threshold": 7, "cell_px": 32, **STEREO}


def plateaus(height: int, width: int) -> np.ndarray:
    """An image of few grey levels, full of equal scores, with saturated pixels."""
    rng = np.random.default_rng(4)
    return (
        (rng.integers(0, 4, (height // 3 + 1, width // 3 + 1)) * 85)
        .astype(np.uint8)
        .repeat(3, axis=0)
        .repeat(3, axis=1)[:height, :width]
        .copy()
    )


IMAGES = {
    "texture": texture(70, 150, 1),
    "faint": texture(64, 97, 2, contrast=0.1),
    "plateaus": plateaus(66, 131),
    "noise": np.random.default_rng(3).integers(0, 256, (53, 64), dtype=np.uint8),
    "narrow": np.random.default_rng(5).integers(0, 256, (90, 36), dtype=np.uint8),
}


@pytest.mark.parametrize("threshold", [1, 7, 40])
@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
def test_corners_and_scores_equal_the_definition(image: np.ndarray, threshold: int) -> None:
    positions, scores, offsets = _core.detect_corners(image, threshold)
    expected_positions, expected_scores = corners.detect(image, threshold)
    np.testing.assert_array_equal(positions, expected_positions)
    np.testing.assert_array_equal(scores, expected_scores)
    expected_offsets = corners.refine(corners.fast_scores(image), expected_positions)
    np.testing.assert_allclose(offsets, expected_offsets, rtol=1e-6)


def test_sub_pixel_corners_follow_a_shift_of_the_image() -> None:
    fine = shifted_pair(200, 300, 10.25, seed=30)  # the right image is shifted by 10 1/4 px
    left, right = (_core.detect_corners(image, 20) for image in fine)
    theirs = {(int(x), int(y)): o for (x, y), o in zip(right[0], right[2], strict=True)}
    error = []
    for (x, y), offset in zip(left[0], left[2], strict=True):
        for whole in (10, 11):
            other = theirs.get((int(x) - whole, int(y)))
            if other is not None:
                error.append(offset - other + (whole, 0) - (10.25, 0))
    assert len(error) > 200
    # Whole pixels would be off by 0.25 px at least along x.
    assert 1.4826 * np.median(np.abs(error), axis=0).max() < 0.12


def test_corners_agree_with_opencv() -> None:
    image = texture(300, 400, 6)
    positions, scores, _ = _core.detect_corners(image, 10)
    # OpenCV's response is the largest threshold at which it is a corner; it drops ties.
    theirs = {
        (round(k.pt[0]), round(k.pt[1])): k.response + 1
        for k in cv2.FastFeatureDetector_create(10, True).detect(image, None)
    }
    ours = {(int(x), int(y)): int(s) for (x, y), s in zip(positions, scores, strict=True)}
    inside = {
        (x, y): score
        for (x, y), score in theirs.items()
        if 17 <= x < 400 - 17 and 17 <= y < 300 - 17
    }
    assert len(inside) > 500
    assert inside.items() <= ours.items()


@pytest.mark.parametrize("shape", [(34, 200), (200, 34), (1, 1), (3, 500)])
def test_images_without_an_inside_have_no_corners(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    assert len(_core.detect_corners(noise, 5)[0]) == 0


def test_order_takes_the_best_of_each_cell_in_turn() -> None:
    image = texture(200, 300, 7)
    positions, scores, _ = _core.detect_corners(image, 5)
    order = _core.order_corners(positions, scores, 300, 200, 32)
    np.testing.assert_array_equal(order, corners.spread_order(positions, scores, 32))
    first = positions[order[:40]] // 32
    assert len(np.unique(first, axis=0)) == 40


@pytest.mark.parametrize("most", [1, 60, 100_000])
def test_best_corners_are_the_first_in_order(most: int) -> None:
    image = np.random.default_rng(4).integers(0, 256, (150, 260), dtype=np.uint8)
    positions, scores, offsets = _core.detect_corners(image, 30)
    best = _core.order_corners(positions, scores, 260, 150, 32)[:most]
    pixels, descriptors = _core.best_corners(image, 30, 32, most)
    assert len(pixels) == min(most, len(positions)) > 0
    np.testing.assert_array_equal(pixels, positions[best].astype(np.float64) + offsets[best])
    described = _core.describe(_core.smooth(image), np.ascontiguousarray(positions[best]))
    np.testing.assert_array_equal(descriptors, described)
    flat, none = _core.best_corners(np.zeros((64, 64), np.uint8), 30, 32, most)
    assert (flat.shape, none.shape) == ((0, 2), (0, 32))


@pytest.mark.parametrize("shape", [(40, 97), (5, 5), (66, 200)])
def test_smoothing_and_halving_equal_the_definition(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(8).integers(0, 256, shape, dtype=np.uint8)
    image[:4, :4] = 255
    np.testing.assert_array_equal(_core.smooth(image), brief.smooth(image))
    np.testing.assert_array_equal(_core.halve(image), brief.halve(image))


def test_descriptors_equal_the_definition() -> None:
    image = _core.smooth(texture(120, 160, 9))
    positions, _, _ = _core.detect_corners(image, 5)
    assert len(positions) > 50
    expected = brief.describe(image, positions)
    np.testing.assert_array_equal(_core.describe(image, positions), expected)


def darker(image: np.ndarray, gain: float, offset: float = 0.0) -> np.ndarray:
    return np.clip(np.rint(image * gain + offset), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
def test_evened_images_equal_the_definition(image: np.ndarray) -> None:
    np.testing.assert_array_equal(_core.even_contrast(image), sides.even_contrast(image))


@pytest.mark.parametrize("shape", [(15, 40), (34, 34), (150, 330), (200, 500)])
@pytest.mark.parametrize("gain", [1.0, 0.6])
def test_how_much_sides_differ_equals_the_definition(shape: tuple[int, int], gain: float) -> None:
    left, right = (texture(*shape, seed) for seed in (31, 32))
    right = darker(right, gain)
    mask = np.ones(shape, np.bool_)
    mask[-40:, :90] = False
    for seen in (None, mask, np.zeros_like(mask)):
        found = _core.side_difference(left, right, 60, seen)
        assert found == pytest.approx(sides.side_difference(left, right, 60, seen), rel=1e-3)


def measure_all(left: np.ndarray, right: np.ndarray, positions: np.ndarray, **changed: float):
    return _core.measure_disparities(left, right, positions, **{**STEREO, **changed})


@pytest.mark.parametrize("sides_differ", [False, True])
@pytest.mark.parametrize("noise", [0.0, 4.0])
def test_disparities_equal_the_definition(noise: float, sides_differ: bool) -> None:
    left, right = shifted_pair(68, 220, 12.25, seed=10, noise=noise)
    right[:, 100:110] = 40  # an occluder, so that some are refused
    if sides_differ:
        right = darker(right, 0.4)
    positions, _, _ = _core.detect_corners(left, 10)
    measured, sigma = measure_all(left, right, positions, sides_differ=sides_differ)
    definition = partial(disparity.measure, left, right, sides_differ=sides_differ, **STEREO)
    accepted = 0
    for (x, y), d, s in zip(positions, measured, sigma, strict=True):
        expected = definition(int(x), int(y))
        assert (d > 0) == (expected is not None)
        if expected is not None:
            accepted += 1
            # float32 of the same sums in float64
            np.testing.assert_allclose((d, s), expected, rtol=1e-5)
    assert 0.4 * len(positions) < accepted < len(positions)


@pytest.mark.parametrize("truth_px", [3.0, 17.25, 30.5, 41.75])
def test_sub_pixel_disparity_is_true_and_its_sigma_honest(truth_px: float) -> None:
    left, right = shifted_pair(240, 400, truth_px, seed=11, noise=8.0)
    positions, _, _ = _core.detect_corners(left, 10)
    measured, sigma = measure_all(left, right, positions, sigma_floor_px=0.0)
    error = measured[measured > 0] - truth_px
    predicted = sigma[measured > 0]
    assert len(error) > 0.5 * len(positions)
    assert abs(np.median(error)) < 0.02  # pull towards whole pixels, plus 3σ of the median
    normalised = error / predicted
    # Half way between two pixels the linear model leaves some residual: σ is somewhat too large.
    assert 0.5 < 1.4826 * np.median(np.abs(normalised)) < 1.2


CHANGES = {
    "as it is": lambda image: image,
    "× 0.7": lambda image: darker(image, 0.7),
    "× 0.35": lambda image: darker(image, 0.35),
    "fogged": lambda image: darker(image, 0.5, 64),
    "dirty": lambda image: darker(image, 0.3, 90),
    "bright": lambda image: darker(image, 1.3),
    "vignetted": lambda image: darker(image, np.linspace(0.3, 1, image.shape[1])),
    "veiled": lambda image: darker(image, 0.5, np.linspace(0, 100, image.shape[1])),
}


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_sides_that_differ_are_measured_as_if_they_did_not(
    change: Callable[[np.ndarray], np.ndarray], side: str
) -> None:
    pair = dict(zip(("left", "right"), shifted_pair(240, 480, 17.25, seed=11), strict=True))
    pair[side] = change(pair[side])
    settings = {**EXTRACT, "landmarks": 300, "max_residual": 0.7}
    _, measured, sigma, _, _, _ = _core.extract(
        *pair.values(), with_descriptors=False, side_difference=0.25, **settings
    )
    error = measured - 17.25
    assert len(error) == 300
    assert (np.abs(error) < 1).mean() > 0.98
    assert abs(np.median(error)) < 0.02
    # Grey levels of the darker side are coarser: σ has to know.
    assert 1.4826 * np.median(np.abs(error / sigma)) < 1


def test_sides_that_are_alike_give_the_same_bits() -> None:
    left, right = shifted_pair(300, 400, 9.5, seed=16, noise=2.0)
    for gain, same in ((1.0, True), (0.95, True), (0.6, False)):
        never, where_they_differ = (
            _core.extract(
                left, darker(right, gain), with_descriptors=True, side_difference=limit, **EXTRACT
            )
            for limit in (0, 0.25)
        )
        assert np.array_equal(never[1], where_they_differ[1]) == same


def test_the_robots_body_does_not_make_sides_differ() -> None:
    left, right = shifted_pair(300, 480, 9.5, seed=16)
    mask = np.ones(left.shape, np.bool_)
    mask[150:] = False
    left[~mask] = 20  # painted over
    assert _core.side_difference(left, right, 60) > 0.5
    assert _core.side_difference(left, right, 60, mask) < 0.1
    with pytest.raises(ValueError, match="mask and left image differ in size"):
        _core.side_difference(left, right, 60, mask[1:])


def test_a_repeated_pattern_has_no_disparity() -> None:
    tile = texture(120, 16, 12)
    image = np.tile(tile, (1, 20))
    positions, _, _ = _core.detect_corners(image, 5)
    assert len(positions) > 50
    assert not measure_all(image, image, positions)[0].any()


def test_what_the_right_image_does_not_show_has_no_disparity() -> None:
    left, other = texture(120, 300, 13), texture(120, 300, 14)
    positions, _, _ = _core.detect_corners(left, 10)
    measured, _ = measure_all(left, other, positions)
    # Chance likeness passes uniqueness and mutual check now and then.
    assert (measured > 0).mean() < 0.02


def test_extract_is_its_steps_put_together() -> None:
    left, right = shifted_pair(150, 260, 9.5, seed=15, noise=2.0)
    settings = {**EXTRACT, "octaves": 1, "landmarks": 60}
    pixels, measured, sigma, descriptors, octaves, found = _core.extract(
        left, right, with_descriptors=True, **settings
    )
    positions, scores, offsets = _core.detect_corners(left, 7)
    order = _core.order_corners(positions, scores, 260, 150, 32)
    places = positions + offsets
    nearest = np.floor(places + 0.5).astype(np.int16).clip([17, 17], [260 - 18, 150 - 18])
    d, s = measure_all(left, right, nearest)
    taken = np.sort([i for i in order if d[i] > 0][:60])
    assert found == len(positions)
    assert len(taken) == 60
    np.testing.assert_allclose(pixels, places[taken], atol=1e-5)
    np.testing.assert_array_equal(measured, d[taken])
    np.testing.assert_array_equal(sigma, s[taken])
    expected = _core.describe(_core.smooth(left), positions[taken])
    np.testing.assert_array_equal(descriptors, expected)
    assert not octaves.any()


def test_octaves_share_the_landmarks() -> None:
    left, right = shifted_pair(300, 400, 9.5, seed=16)
    result = _core.extract(left, right, with_descriptors=False, **{**EXTRACT, "octaves": 3})
    # 1 : 1/2 : 1/4 of 150; here every octave fills its share.
    assert np.bincount(result[4]).tolist() == [85, 43, 22]
    assert result[3].shape == (0, 32)
    assert np.abs(result[1] - 9.5).max() < 0.3


def test_a_second_look_changes_nothing_where_the_first_finds_enough() -> None:
    left, right = shifted_pair(300, 400, 9.5, seed=16)
    once, twice = (
        _core.extract(left, right, with_descriptors=True, second_threshold=second, **EXTRACT)
        for second in (0, 3)
    )
    for before, after in zip(once, twice, strict=True):
        np.testing.assert_array_equal(before, after)


def test_a_second_look_finds_disparities_behind_a_drop() -> None:
    left, right = shifted_pair(200, 320, 12.5, seed=21, noise=1.0)
    right = cv2.blur(right, (9, 9))
    settings = {**EXTRACT, "landmarks": 600}
    _, first, _, _, _, _ = _core.extract(left, right, with_descriptors=False, **settings)
    _, second, sigma, _, _, _ = _core.extract(
        left, right, with_descriptors=False, second_threshold=3, **settings
    )
    found = [int((np.abs(each - 12.5) < 1).sum()) for each in (first, second)]
    assert found[1] > 2 * found[0]
    assert found[1] > 0.8 * len(second)
    assert 0 < sigma.max() <= EXTRACT["max_sigma_px"]


def test_any_image_size_is_read_within_bounds() -> None:
    rng = np.random.default_rng(17)
    for height, width in [(1, 1), (2, 3), (35, 35), (36, 64), (64, 35), (35, 300), (77, 131)]:
        image = rng.integers(0, 256, (height, width), dtype=np.uint8)
        for most in (1, 60, 500):
            _core.extract(
                image,
                image,
                with_descriptors=True,
                second_threshold=1,
                side_difference=1e-9,
                **{**EXTRACT, "octaves": 4, "fast_threshold": 1, "max_disparity_px": most},
            )


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"octaves": 5}, "octaves must lie in 1 to 4"),
        ({"landmarks": 0}, "landmarks must lie"),
        ({"fast_threshold": 255}, "FAST threshold must lie"),
        ({"second_threshold": 255}, "second_threshold must lie"),
        ({"max_disparity_px": 501}, "max_disparity_px must lie"),
        ({"cell_px": 0}, "cell_px must be"),
    ],
)
def test_settings_out_of_range_are_refused(changed: dict[str, int], said: str) -> None:
    image = texture(64, 64, 18)
    with pytest.raises(ValueError, match=said):
        _core.extract(image, image, with_descriptors=True, **{**EXTRACT, **changed})


def test_arrays_that_do_not_fit_are_refused() -> None:
    image = texture(64, 80, 19)
    with pytest.raises(ValueError, match="differ in size"):
        _core.extract(image, image[:, :64].copy(), with_descriptors=True, **EXTRACT)
    with pytest.raises(ValueError, match="less than 17 px inside"):
        _core.describe(image, np.array([[16, 20]], np.int16))


def digest() -> str:
    """Hash of all that extraction computes on two images."""
    total = hashlib.sha256()
    usual = shifted_pair(200, 330, 21.75, seed=20, noise=5.0)
    pairs = usual, (usual[0], darker(usual[1], 0.4)), (IMAGES["noise"],) * 2
    for left, right in pairs:
        settings = {**EXTRACT, "landmarks": 600, "second_threshold": 3, "side_difference": 0.25}
        for part in _core.extract(left, right, with_descriptors=True, **settings)[:5]:
            total.update(np.ascontiguousarray(part).tobytes())
        total.update(_core.detect_corners(left, 3)[1].tobytes())
    return total.hexdigest()


def test_every_instruction_set_computes_the_same_bits() -> None:
    code = """
import sys
sys.path.insert(0, sys.argv[1])
from tests.core.test_extraction import digest
print(digest())
"""
    assert len(printed(code)) == 1


@pytest.mark.parametrize("shape", [(1, 1), (3, 85), (40, 97)])
def test_equal_pixels_are_counted_between_black_and_white(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(9)
    now, other = rng.integers(0, 256, (2, *shape), dtype=np.uint8)
    before = np.where(rng.random(shape) < 0.5, now, other)
    tells = (now > 2) & (now < 253)
    equal = np.count_nonzero(tells & (now == before))
    assert _core.equal_pixels(now, before, 2, 253) == (np.count_nonzero(tells), equal)
    with pytest.raises(ValueError, match="size"):
        _core.equal_pixels(now, np.zeros((7, 7), np.uint8), 2, 253)
