"""Guided matching equals brute force, whatever the prediction and the number of landmarks."""

import dataclasses

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.reference import guided_matching
from tests.scenes import Scene

from engram import _core
from engram.frontend.frame import Frame
from engram.frontend.matching import MatcherConfig, core_settings, features
from engram.geometry.se3 import SE3

CONFIG = MatcherConfig()
REFERENCE_FROM_LIVE = SE3.exp([0.2, -0.05, 0.6, 0.02, 0.05, 0.01])


def found(reference: Frame, live: Frame, predicted: SE3, covariance: np.ndarray) -> list:
    rows, columns = _core.match_rows(
        features(reference), features(live), core_settings(CONFIG), predicted.matrix(), covariance
    )
    return list(zip(rows.tolist(), columns.tolist(), strict=True))


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**20),
    points=st.sampled_from([1, 3, 15, 16, 17, 40, 250]),
    sigma=st.sampled_from([1e-4, 0.01, 0.1, 3.0, float("inf")]),
    octaves=st.integers(1, 3),
    flipped=st.sampled_from([0.0, 0.08, 0.3]),
    error=st.lists(st.floats(-0.05, 0.05), min_size=6, max_size=6),
)
def test_equals_brute_force(seed, points, sigma, octaves, flipped, error) -> None:
    scene = Scene(points, seed)
    # Twice the same descriptors: rivals, at the same corner and elsewhere.
    scene.descriptors[points // 2 :] = scene.descriptors[: points - points // 2]
    frames = []
    for pose in (SE3.identity(), REFERENCE_FROM_LIVE):
        frame = scene.seen_from(pose, flipped_bits=flipped)[0]
        marks = frame.landmarks
        levels = scene.rng.integers(0, octaves, len(marks)).astype(np.uint8)
        frames.append(
            dataclasses.replace(frame, landmarks=dataclasses.replace(marks, octaves=levels))
        )
    predicted = SE3.exp(error) @ REFERENCE_FROM_LIVE
    covariance = np.eye(6) * min(sigma, 1e6) ** 2
    expected = guided_matching.match_near(*frames, predicted, covariance, CONFIG)
    assert found(*frames, predicted, covariance) == expected


def test_memory_of_an_earlier_call_changes_nothing() -> None:
    scene = Scene(600, 1)
    reference = scene.seen_from(SE3.identity())[0]
    live = scene.seen_from(REFERENCE_FROM_LIVE)[0]
    few = Scene(20, 2)
    small = few.seen_from(SE3.identity())[0], few.seen_from(REFERENCE_FROM_LIVE)[0]
    covariance = np.eye(6) * 0.01
    first = found(*small, REFERENCE_FROM_LIVE, covariance)
    assert len(found(reference, live, REFERENCE_FROM_LIVE, covariance)) > 200
    assert found(*small, REFERENCE_FROM_LIVE, covariance) == first
