"""Landmarks that a node has beyond those of its live frame."""

from dataclasses import replace

import numpy as np
import pytest
from tests.frontend.test_ranked import BODY, PLAIN, POOR, assert_equal, ranked

from engram.frontend.features import NET
from engram.frontend.frame import BRIEF, DescriptorKind, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig, as_live


@pytest.mark.parametrize("kind", [BRIEF, NET])
@pytest.mark.parametrize("pair", [PLAIN, POOR, replace(PLAIN, mask=BODY)])
def test_they_are_those_that_the_front_end_would_choose_next(
    kind: DescriptorKind, pair: StereoPair
) -> None:
    config = FrontendConfig(descriptor=kind, landmarks=400)
    live = Frontend(config).extract(pair)
    own = len(live.landmarks)
    node = live.with_further(700)
    assert_equal(node.first(own).landmarks, live.landmarks)
    further = node.landmarks.rows(slice(own, None))
    assert len(further) > 200
    assert_equal(further, ranked(pair, config).further(own, 700))
    if pair.mask is None:
        assert_equal(as_live(node, config).landmarks, live.landmarks)


def test_a_node_of_no_more_is_the_live_frame() -> None:
    live = Frontend().extract(PLAIN)
    for count in (0, 600):
        node = live.with_further(count)
        assert_equal(node.landmarks, live.landmarks)
        assert node.further is None


def test_what_moves_with_the_camera_is_not_made_up_for() -> None:
    live = Frontend().extract(PLAIN)
    some = replace(live, landmarks=live.landmarks.rows(slice(500)), left_out=100)
    assert len(some.with_further(600).landmarks) == 500
    assert len(some.with_further(700).landmarks) == 600


def test_a_frame_from_a_map_has_none() -> None:
    live = replace(Frontend().extract(PLAIN), further=None)
    assert len(live.with_further(1000).landmarks) == len(live.landmarks)
    assert np.shares_memory(live.first(600).landmarks.pixels, live.landmarks.pixels)
