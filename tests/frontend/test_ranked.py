"""Landmarks in the order of the front-end's choice."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.core.textures import shifted_pair

from engram.frontend.features import NET
from engram.frontend.frame import BRIEF, DescriptorKind, Landmarks, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.frontend.ranked import RankedLandmarks, ranked_landmarks
from engram.geometry.cameras import StereoCamera

CAMERA = StereoCamera(400.0, 400.0, 255.5, 191.5, 0.2, 512, 384)
LEFT, RIGHT = shifted_pair(384, 512, 12.25, seed=1, noise=2.0)
PLAIN = StereoPair(1, LEFT, RIGHT, CAMERA)
# So blurred on one side that the second look replaces the first.
POOR = replace(PLAIN, left=cv2.GaussianBlur(LEFT, (0, 0), 4.0), right=cv2.blur(RIGHT, (17, 17)))
BODY = np.ones(LEFT.shape, dtype=bool)
BODY[300:, 100:300] = False


def ranked(pair: StereoPair, config: FrontendConfig, most: int = 2000) -> RankedLandmarks:
    found = ranked_landmarks(pair, config, most)
    assert found is not None
    return found


def assert_equal(one: Landmarks, other: Landmarks) -> None:
    for name in Landmarks.__slots__:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("kind", [BRIEF, NET])
@pytest.mark.parametrize("pair", [PLAIN, POOR, replace(PLAIN, mask=BODY)])
def test_the_frame_s_own_are_the_first(kind: DescriptorKind, pair: StereoPair) -> None:
    config = FrontendConfig(descriptor=kind)
    found = ranked(pair, config)
    assert_equal(found.first(config.landmarks), Frontend(config).extract(pair).landmarks)


_KEPT = {
    octaves: ranked(PLAIN, FrontendConfig(octaves=octaves, second_threshold=0))
    for octaves in (1, 2, 3)
}


@given(octaves=st.sampled_from(sorted(_KEPT)), count=st.integers(1, 2000))
@settings(max_examples=60)
def test_any_fewer_are_the_first_of_them(octaves: int, count: int) -> None:
    config = FrontendConfig(octaves=octaves, second_threshold=0, landmarks=count)
    assert_equal(_KEPT[octaves].first(count), Frontend(config).extract(PLAIN).landmarks)


@pytest.mark.parametrize("count", [1, 20, 300, 2000])
def test_so_they_are_where_the_second_look_replaced_the_first(count: int) -> None:
    config = FrontendConfig()
    once = Frontend(replace(config, second_threshold=0)).extract(POOR)
    assert len(once.landmarks) < config.landmarks
    always = Frontend(replace(config, landmarks=count, fast_threshold=254)).extract(POOR)
    assert_equal(ranked(POOR, config).first(count), always.landmarks)


@given(seed=st.integers(0, 1000), count=st.integers(0, 400))
@settings(max_examples=30)
def test_what_is_parted_is_joined_again(seed: int, count: int) -> None:
    whole = _KEPT[2]
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.permutation(len(whole.ranks))[:400])
    some = RankedLandmarks(
        Landmarks(*(getattr(whole.landmarks, name)[rows] for name in Landmarks.__slots__)),
        whole.ranks[rows],
    )
    own, more = some.parted(count)
    assert len(own) == count
    assert_equal(RankedLandmarks.joined(own, more, some.ranks).landmarks, some.landmarks)
    with pytest.raises(ValueError, match="ranks"):
        RankedLandmarks.joined(own, more, some.ranks[:-1])
