"""Steps after which the images go on elsewhere, told by inliers alone."""

from __future__ import annotations

import numpy as np
import pytest

from engram.geometry.se3 import SE3
from engram.odometry.motion import GapFiller, Jumps
from engram.odometry.step import Guess, OdometryStatus, OdometryStep

STEP = OdometryStep(
    OdometryStatus.OK, SE3(np.eye(3), np.array([0.0, 0.0, 0.7])), np.eye(6) * 1e-4, 200
)
FAILED = OdometryStep(OdometryStatus.NO_CONSENSUS)


def _jumped_at(inliers: list[int]) -> list[int]:
    jumps = Jumps(share=0.1, least=60)
    return [at for at, one in enumerate(inliers) if jumps.jumped(one, 0.1)]


@pytest.mark.parametrize(
    ("around", "expected"),
    [
        ([0], [21]),
        ([19], [21]),
        ([20], []),  # a tenth of what is usual: weak, but a motion
        ([0, 0], []),  # a flash fits neither the frame before nor the one after
        ([0, 59], []),
        ([150, 180], []),
    ],
)
def test_one_step_that_fails_between_good_ones_is_a_jump(
    around: list[int], expected: list[int]
) -> None:
    assert _jumped_at([200] * 20 + around + [200] * 10) == expected


def test_wipers_are_no_jumps() -> None:
    """The first stroke may be taken for one; that the others come so soon tells them."""
    strokes = ([200] * 8 + [0]) * 6
    assert _jumped_at([200] * 20 + strokes) == [29]


def test_where_landmarks_are_few_steps_fail_by_themselves() -> None:
    assert _jumped_at([50] * 20 + [0] + [50] * 5) == []
    assert _jumped_at([200] * 20 + [0] + [50] * 5) == []


def test_where_frames_are_missing_the_time_bounds_the_guess() -> None:
    jumps = Jumps(share=0.1, least=60)
    steps = [(200, 0.1)] * 20 + [(0, 0.5), (200, 0.1)]
    assert not any(jumps.jumped(*step) for step in steps)


def test_wheels_know_of_a_motion_that_the_images_do_not_show() -> None:
    rolled = Guess(STEP.prev_from_curr, STEP.covariance, 0.02)
    for outside, jumped in ((None, True), (rolled, False)):
        gaps = GapFiller()
        for at, step in enumerate([OdometryStep(OdometryStatus.FIRST), *[STEP] * 20, FAILED, STEP]):
            motion = gaps.motion(step, at * 10**8, outside)
        assert motion.jumped is jumped
        assert motion.odometry is STEP
