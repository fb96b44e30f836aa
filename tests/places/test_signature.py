"""Signatures of whole images: what they have in common, and what they refuse."""

from dataclasses import replace

import numpy as np
import pytest
from tests.core.textures import shifted_pair

from engram.errors import IncompatibleError
from engram.frontend.features import NET
from engram.frontend.frame import BRIEF, Frame, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.geometry.cameras import StereoCamera
from engram.places.recognisers import ReadsFrames, Signatures
from engram.places.vocabulary import default_vocabulary

CAMERA = StereoCamera(260.0, 260.0, 160.0, 120.0, 0.2, 320, 240)
VOCABULARY = default_vocabulary(NET)


def frame(seed: int, noise: float = 1.0) -> Frame:
    left, right = shifted_pair(240, 320, 12.25, seed=seed, noise=noise)
    return Frontend(FrontendConfig(descriptor=NET)).extract(StereoPair(1, left, right, CAMERA))


def without_landmarks(seen: Frame) -> Frame:
    marks = seen.landmarks
    rows = {name: getattr(marks, name)[:0] for name in marks.__slots__}
    return replace(seen, landmarks=replace(marks, **rows))


def test_a_place_is_found_again_through_noise() -> None:
    recogniser = Signatures(VOCABULARY)
    assert isinstance(recogniser, ReadsFrames)
    for seed in range(4):
        assert recogniser.add(recogniser.signature(frame(seed))) == seed
    for seed in range(4):
        found = recogniser.recognise(recogniser.signature(frame(seed, noise=4.0)), 2)
        assert found.places[0] == seed
        assert found.scores[0] > found.scores[1]
        assert found.new_place is None


def test_equal_frames_agree_and_a_place_without_landmarks_agrees_by_chance() -> None:
    recogniser, seen = Signatures(VOCABULARY), frame(5)
    nothing = recogniser.signature(without_landmarks(seen))
    for shown in (recogniser.signature(seen), nothing, np.zeros(0, np.int32)):
        recogniser.add(shown)
    own = recogniser.similarities(recogniser.signature(seen))
    # A texture has landmarks of few of the kinds: what both lack agrees by half.
    assert own[0] > own[1] + 0.1
    assert abs(own[1] - 0.5) < 0.05
    assert own[1] == own[2]
    np.testing.assert_array_equal(recogniser.similarities(nothing)[1:], 0.5)


def test_a_bit_says_that_it_is_set_more_often_than_usual() -> None:
    recogniser = Signatures(VOCABULARY)
    seen = frame(6)
    marks = seen.landmarks
    again = replace(  # every landmark twice: shares are the same
        marks, **{name: np.concatenate([getattr(marks, name)] * 2) for name in marks.__slots__}
    )
    np.testing.assert_array_equal(
        recogniser.signature(seen), recogniser.signature(replace(seen, landmarks=again))
    )


def test_other_kinds_are_refused() -> None:
    with pytest.raises(IncompatibleError, match=r"use --set drive\.relocaliser=fabmap"):
        Signatures(default_vocabulary(BRIEF))
    with pytest.raises(IncompatibleError, match="record the drive with --features net"):
        Signatures(VOCABULARY).signature(replace(frame(7), descriptor=BRIEF))
