"""The patch network of the core against its plain twin, to the bit, on every instruction set."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.core.textures import texture
from tests.instruction_sets import printed
from tests.reference import patch_network as plain

from engram import _core

BITS = 64


def weights(seed: int, bits: int = BITS) -> dict[str, np.ndarray]:
    """Random weights whose layers use their whole range."""
    rng = np.random.default_rng(seed)
    arrays: dict[str, np.ndarray] = {}
    shapes = {"first": (16, 5, 5, 1), "second": (32, 3, 3, 16), "third": (48, 3, 3, 32)}
    for name, shape in shapes.items():
        arrays[name] = rng.integers(-127, 128, shape, dtype=np.int8)
        bias = rng.integers(-90_000, 90_000, shape[0])
        factor = rng.integers(1, 2**15, shape[0])
        arrays[f"{name}_scaling"] = np.column_stack([bias, factor]).astype(np.int32)
    arrays["linear"] = rng.integers(-127, 128, (bits, 3, 3, 48), dtype=np.int8)
    arrays["thresholds"] = rng.integers(-100_000, 100_000, bits).astype(np.int32)
    arrays["shifts"] = np.array([[3, 21], [5, 21], [6, 21]], np.int32)
    return arrays


def points(seed: int, count: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0, 1, (count, 2)) * [width - 1, height - 1]
    return pixels.astype(np.float32), rng.integers(0, 3, count).astype(np.uint8)


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 9))
def test_the_network_computes_what_its_twin_computes(seed: int, count: int) -> None:
    image, (pixels, octaves) = texture(100, 131, seed=seed), points(seed, count, 131, 100)
    arrays = weights(seed)
    found = _core.PatchNetwork(**arrays).describe(image, pixels, octaves)
    np.testing.assert_array_equal(found, plain.describe(arrays, image, pixels, octaves))


def test_extremes_do_not_overflow() -> None:
    arrays = weights(3)
    for name in ("first", "second", "third", "linear"):
        arrays[name] = np.where(arrays[name] > 0, 127, -127).astype(np.int8)
    edges = np.zeros((96, 96), np.uint8)
    edges[:, 48:] = 255
    for image in (edges, np.zeros_like(edges), np.full_like(edges, 255), edges.T.copy()):
        pixels, octaves = np.array([[48, 48], [0, 0], [95, 95]], np.float32), np.zeros(3, np.uint8)
        found = _core.PatchNetwork(**arrays).describe(image, pixels, octaves)
        np.testing.assert_array_equal(found, plain.describe(arrays, image, pixels, octaves))


def test_a_descriptor_depends_on_its_own_patch_only() -> None:
    image, (pixels, octaves) = texture(120, 160, seed=1), points(1, 37, 160, 120)
    network = _core.PatchNetwork(**weights(1))
    together = network.describe(image, pixels, octaves)
    alone = [network.describe(image, pixels[k : k + 1], octaves[k : k + 1])[0] for k in range(37)]
    np.testing.assert_array_equal(together, alone)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"first": np.zeros((16, 3, 3, 1), np.int8)}, r"first has the wrong shape, expected \(16"),
        ({"linear": np.zeros((32, 3, 3, 48), np.int8)}, "linear has the wrong shape"),
        ({"thresholds": np.zeros(60, np.int32)}, "multiple of 64"),
        ({"shifts": np.array([[3, 0], [5, 21], [6, 21]], np.int32)}, "shifts must lie in"),
        ({"third_scaling": np.full((48, 2), 2**16, np.int32)}, "out of range"),
    ],
)
def test_weights_that_do_not_fit_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _core.PatchNetwork(**{**weights(0), **change})


def test_points_outside_the_image_are_refused() -> None:
    network = _core.PatchNetwork(**weights(0))
    image, octaves = np.zeros((100, 100), np.uint8), np.zeros(1, np.uint8)
    for point in ([100, 5], [5, -1], [np.nan, 5]):
        with pytest.raises(ValueError, match="a point lies outside the image"):
            network.describe(image, np.array([point], np.float32), octaves)


def digest() -> str:
    image, (pixels, octaves) = texture(384, 512, seed=2), points(2, 601, 512, 384)
    found = _core.PatchNetwork(**weights(2, 192)).describe(image, pixels, octaves)
    return hashlib.sha256(found.tobytes()).hexdigest()


def test_every_instruction_set_computes_the_same_bits() -> None:
    code = """
import sys
sys.path.insert(0, sys.argv[1])
from tests.core.test_patch_network import digest
print(digest())
"""
    assert len(printed(code)) == 1
