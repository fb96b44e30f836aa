"""What is fixed to the camera is told from the world, and from what is merely far or at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from tests.reference import kept

from engram.frontend.frame import StereoPair
from engram.frontend.frontend import Frontend
from engram.geometry.se3 import SE3
from engram.odometry.fixed import FixedConfig, FixedPixels, kept_rows
from engram.odometry.odometry import Odometry
from engram.odometry.outside import OutsideModel, OutsideMotion
from engram_lab.bench.data import synthetic_drive
from engram_lab.studies.faults.injected import (
    brightened,
    fixed_pattern,
    halved,
    on_both,
    reaching_in,
)

STEP_M = 0.8
FRAMES = 16


@pytest.fixture(scope="module")
def pairs() -> list[StereoPair]:
    return [halved(one, 2.0) for one in synthetic_drive(frames=FRAMES, step_m=STEP_M)]


def noisy(pair: StereoPair, seed: int, sigma: float = 1.5) -> StereoPair:
    rng = np.random.default_rng(seed)
    return on_both(
        pair,
        lambda one: np.clip(one + rng.normal(0, sigma, one.shape), 0, 255).astype(np.uint8),
    )


def at_rest(pairs: Sequence[StereoPair]) -> list[StereoPair]:
    return [noisy(replace(pairs[0], stamp_ns=one.stamp_ns), k) for k, one in enumerate(pairs)]


def with_pattern(pairs: Sequence[StereoPair], share: float, **kind: object) -> list[StereoPair]:
    shown = fixed_pattern(pairs, share, 0, np.random.default_rng(3), **kind)  # type: ignore[arg-type]
    return [noisy(one.pair, k, 0.7) for k, one in enumerate(shown)]


def driven(
    pairs: Sequence[StereoPair], told: SE3 | None = None
) -> tuple[FixedPixels, float, int, int]:
    """What was learnt, odometry's way, frames that lost landmarks, frames in doubt."""
    frontend, odometry, fixed, outside = Frontend(), Odometry(), FixedPixels(), OutsideModel()
    way_m, thinned, doubted = 0.0, 0, 0
    for k, pair in enumerate(pairs):
        frame = frontend.extract(pair)
        if k and told is not None:
            outside.add(OutsideMotion(told, 0.1))
        look = fixed.look(frame, outside.guess(), told if k else None)
        step = odometry.step(look.frame)
        fixed.note(step.prev_from_curr, step.inliers)
        way_m += step.moved_m
        thinned += look.frame is not frame
        doubted += look.doubted
    return fixed, way_m, thinned, doubted


@pytest.mark.parametrize("side", ["bottom", "top", "left", "right"])
@pytest.mark.parametrize(("share", "contrast"), [(0.15, 1.0), (0.35, 1.0), (0.35, 0.4), (0.6, 1.0)])
def test_a_part_that_moves_with_the_camera_is_learnt(pairs, side, share, contrast) -> None:
    shown = with_pattern(pairs, share, side=side, depth_m=2.0, contrast=contrast)
    fixed, way_m, _, doubted = driven(shown)
    assert way_m == pytest.approx(STEP_M * (FRAMES - 1), rel=0.05)
    assert doubted <= 1
    camera = pairs[0].camera
    learnt = ~fixed.mask(camera)
    covered = reaching_in(camera.height, camera.width, side, share)
    # Cells at its edge reach over it; strips that the right camera does not see have no depth.
    assert (learnt & ~covered).mean() < 0.07
    # A narrow one does no harm, and need not be learnt.
    assert share < 0.2 or (learnt & covered).sum() > 0.4 * covered.sum()


def test_a_far_thing_on_the_camera_is_learnt_as_it_lies_at_one_depth(pairs) -> None:
    fixed, way_m, _, _ = driven(with_pattern(pairs, 0.4, side="right", depth_m=12.0, contrast=1.0))
    assert way_m == pytest.approx(STEP_M * (FRAMES - 1), rel=0.03)
    assert fixed.share > 0.2


def test_a_sound_drive_keeps_every_landmark(pairs) -> None:
    fixed, _, thinned, doubted = driven(pairs)
    assert (fixed.share, thinned, doubted) == (0.0, 0, 0)


def test_a_robot_at_rest_learns_nothing(pairs) -> None:
    fixed, way_m, thinned, doubted = driven(at_rest(pairs))
    assert (fixed.share, thinned, doubted) == (0.0, 0, 0)
    assert way_m < 0.05


def test_a_robot_at_rest_in_light_that_comes_and_goes_is_believed(pairs) -> None:
    dimmed = [
        on_both(one, lambda image, k=k: brightened(image, 0.35 + 0.325 * (1 + np.sin(k / 3))))
        for k, one in enumerate(at_rest(pairs))
    ]
    fixed, way_m, _, doubted = driven(dimmed)
    assert (fixed.share, doubted, fixed.doubts) == (0.0, 0, 0)
    assert way_m < 0.1


def passing(pairs: Sequence[StereoPair]) -> list[StereoPair]:
    """A robot at rest; what passes by fills two thirds of its view."""
    camera = pairs[0].camera
    bus = reaching_in(camera.height, camera.width, "left", 0.65)
    rest = at_rest(pairs)
    return [
        replace(
            still,
            left=np.where(bus, one.left, still.left),
            right=np.where(bus, one.right, still.right),
        )
        for still, one in zip(rest, pairs, strict=True)
    ]


def test_wheels_at_rest_decide_that_the_moving_part_passes_by(pairs) -> None:
    fixed, _, thinned, doubted = driven(passing(pairs), told=SE3.identity())
    assert (fixed.share, thinned, doubted) == (0.0, 0, 0)


def test_wheels_that_turn_decide_that_the_resting_part_is_the_robots(pairs) -> None:
    told = SE3(np.eye(3), np.array([0.0, 0.0, STEP_M]))
    shown = with_pattern(pairs, 0.5, side="right", depth_m=9.0, contrast=1.0)
    fixed, way_m, _, doubted = driven(shown, told)
    assert way_m == pytest.approx(STEP_M * (FRAMES - 1), rel=0.03)
    assert doubted == 0
    assert fixed.share > 0.2


def test_nobody_decides_between_a_street_that_rests_and_one_that_moves(pairs) -> None:
    fixed, _, _, doubted = driven(passing(pairs))
    assert fixed.share == 0.0 or doubted
    assert doubted == fixed.doubts


def test_what_has_gone_is_forgotten(pairs) -> None:
    there = with_pattern(pairs, 0.3, side="bottom", depth_m=2.0, contrast=1.0)
    back = [*pairs[::-1], *pairs] * 4
    fixed, _, _, _ = driven(there)
    assert fixed.share > 0.1
    frontend = Frontend()
    stamps = range(10**10, 10**12, 10**8)
    for pair, stamp_ns in zip(back, stamps, strict=False):
        fixed.look(frontend.extract(replace(pair, stamp_ns=stamp_ns)), None, None)
    assert fixed.share == 0.0


def test_landmarks_of_one_picture_keep_their_pixels(pairs) -> None:
    one, other = (Frontend().extract(pairs[k]) for k in (0, 5))
    assert (kept_rows(one, one) == np.arange(len(one.landmarks))).mean() > 0.95
    assert (kept_rows(one, other) >= 0).mean() < 0.2


@pytest.mark.parametrize("later", [0, 1, 2, 5])
@pytest.mark.parametrize(("bits", "disparity_px"), [(45, 1.0), (0, 0.1), (256, 1000.0)])
def test_the_kernel_keeps_what_its_twin_keeps(pairs, later, bits, disparity_px) -> None:
    one, other = (Frontend().extract(noisy(pairs[k], k)) for k in (0, later))
    config = FixedConfig(same_bits=bits, same_disparity_px=disparity_px)
    expected = kept.kept_rows(one.landmarks, other.landmarks, bits, disparity_px)
    np.testing.assert_array_equal(kept_rows(one, other, config), expected)
