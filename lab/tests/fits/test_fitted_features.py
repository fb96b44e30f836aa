"""Training the feature network: what it learns from, and its weights in integers."""

from __future__ import annotations

import numpy as np
import pytest
from tests.core.textures import texture
from tests.reference import patch_network as plain

from engram import _core
from engram_lab.eyes import JUDGED, Patches, drawn_visits

torch = pytest.importorskip("torch", reason="training needs pip install 'engram-lab[train]'")


def test_no_visit_that_is_trained_on_is_judged() -> None:
    for seed in (201, 204):
        drawn = drawn_visits(seed)
        assert len(drawn) == 19
        assert {one.start for one in drawn.values()}.isdisjoint(
            one.start for one in JUDGED.values()
        )
    assert drawn_visits(201) != drawn_visits(202)


def test_integers_give_nearly_all_bits_of_the_trained_network() -> None:
    from engram_lab.fits.features import PatchNetwork, integer_weights, weights_file

    torch.manual_seed(1)
    rng = np.random.default_rng(1)
    image = texture(384, 512, seed=3)
    pixels = rng.uniform([40, 40], [470, 340], (300, 2)).astype(np.float32)
    octaves = np.zeros(300, np.uint8)
    patches = Patches(image).around(pixels, octaves)
    network = PatchNetwork()
    with torch.no_grad():
        for _ in range(30):  # settles the normalisations' statistics
            network(torch.from_numpy(patches))
    network.eval()
    arrays = integer_weights(network, patches)
    found = _core.PatchNetwork(**arrays).describe(image, pixels, octaves)
    with torch.no_grad():
        expected = np.packbits(network(torch.from_numpy(patches)).numpy() > 0, axis=1)
    differing = np.bitwise_count(found ^ expected).mean() / 8
    assert differing < 0.03
    np.testing.assert_array_equal(found[:5], plain.describe(arrays, image, pixels[:5], octaves[:5]))
    body, model = weights_file(arrays, {"seed": "1"})
    assert len(body) < 300_000
    assert len(model) == 8
