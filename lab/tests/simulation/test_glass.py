"""Rain on the glass before a lens, and what is seen through it."""

import math

import numpy as np
import pytest
from lab.tests.simulation.conftest import small

from engram_lab.town.campaigns import campaign_named
from engram_lab.town.drive import robot_named
from engram_lab.town.glass import Glass, Pane, WetLens, film, streaks
from engram_lab.town.session import SimulatedDrive

_CAMERA = robot_named("wildcat").camera


def rained_on(
    rate_mm_h: float, seconds: float, seed: int, glass: Glass | None = None, speed_m_s: float = 5.0
) -> Pane:
    pane = Pane(glass or Glass(), _CAMERA, [seed])
    for _ in range(int(2 * seconds)):
        pane.advance(rate_mm_h, speed_m_s, 0.5)
    return pane


def cover(pane: Pane) -> float:
    return float(WetLens(pane, _CAMERA).mask().mean())


def test_a_pane_in_hard_rain_is_covered_as_far_as_drops_let_each_other() -> None:
    covers = [cover(rained_on(4.0, 120, seed)) for seed in range(6)]
    assert 0.25 < np.mean(covers) < 0.4
    assert 0.1 < min(covers) < max(covers) < 0.5


def test_drops_stay_from_frame_to_frame() -> None:
    pane = rained_on(4.0, 120, 1)
    eye, changed = WetLens(pane, _CAMERA), []
    before = eye.mask()
    for _ in range(60):
        pane.advance(4.0, 5.0, 0.05)
        after = eye.mask()
        changed.append((before != after).mean())
        before = after
    assert 0 < np.mean(changed) < 0.002
    assert np.quantile(changed, 0.95) < 0.01


def test_a_hood_shelters_a_slow_robot_and_a_blade_wipes() -> None:
    open_pane = cover(rained_on(4.0, 60, 1))
    hooded = Glass(hood=1.0)
    assert cover(rained_on(4.0, 60, 1, hooded, speed_m_s=1.5)) < 0.1 * open_pane
    assert cover(rained_on(4.0, 60, 1, hooded, speed_m_s=13.0)) > 0.5 * open_pane
    assert cover(rained_on(4.0, 59, 1, Glass(wiped_every_s=2.0))) < 0.3 * open_pane


def test_drops_dry_when_the_rain_is_over() -> None:
    pane = rained_on(4.0, 30, 2)
    widths = [float(np.sum(pane.widths_mm))]
    for _ in range(3):
        pane.advance(0.0, 5.0, 60.0)
        widths.append(float(np.sum(pane.widths_mm)))
    assert widths == sorted(widths, reverse=True)
    for _ in range(60):
        pane.advance(0.0, 5.0, 60.0)
    assert len(pane.drops) == 0


def one_drop(glass: Glass, width_mm: float) -> WetLens:
    pane = Pane(glass, _CAMERA, [0])
    pane.drops, pane.changes = np.array([[0.0, 0.0, width_mm / glass.spread]]), 1
    return WetLens(pane, _CAMERA)


@pytest.mark.parametrize(("width_mm", "most"), [(1.0, (1 / 1.9) ** 2), (2.2, 1.0)])
def test_a_drop_takes_the_share_of_the_pupil_that_it_covers(width_mm: float, most: float) -> None:
    dark = one_drop(Glass(), width_mm).through(np.ones((384, 512), dtype=np.float32))
    eye = one_drop(Glass(), width_mm)
    eye.through(dark)
    assert eye._takes.max() == pytest.approx(most, rel=0.08)
    # As wide as the drop and the pupil together.
    across_px = (eye._takes[192] > 0.01).sum()
    wanted_px = (width_mm + 1.9) / 15 * _CAMERA.fx
    assert across_px == pytest.approx(wanted_px, rel=0.12)


def test_a_drop_far_from_a_small_pupil_shows_the_world_upside_down() -> None:
    light = np.full((384, 512), 0.2, dtype=np.float32)
    light[:192] = 1.0
    seen = one_drop(Glass(distance_mm=120, pupil_mm=0.5), 20.0).through(light)
    assert seen[180, 256] < 0.4  # above the drop's middle: the road
    assert seen[204, 256] > 0.8
    rim_px = round(8.8 / 120 * _CAMERA.fx)
    assert seen[192 + rim_px, 256] < 0.85 * seen[204, 256]


def test_a_dry_pane_and_light_rain_change_nothing_that_they_do_not_touch() -> None:
    light = np.random.default_rng(0).random((384, 512)).astype(np.float32)
    assert WetLens(Pane(Glass(), _CAMERA, [0]), _CAMERA).through(light) is light
    assert film(light, 8.0, 0.0, [1]) is light
    assert np.abs(film(light, 25.0, 0.0, [1]) - light).mean() > 0.1


def test_streaks_grow_with_the_shutter_and_fade() -> None:
    light = np.zeros((384, 512), dtype=np.float32)
    light[:96] = 1.0
    short = streaks(light, _CAMERA, 10.0, 0.0007, [1])[100:]
    long = streaks(light, _CAMERA, 10.0, 0.004, [1])[100:]
    assert 0 < (short > 0).mean() < 0.05
    assert long.max() < 0.5 * short.max()
    assert math.isclose(float(streaks(light, _CAMERA, 0.2, 0.0007, [1])[100:].max()), 0, abs_tol=1)


def test_a_frame_is_the_same_with_and_without_those_before_it() -> None:
    drive = small(SimulatedDrive(campaign_named("hamlet", seed=3), 4))
    drive.poses = drive.poses[:12]
    through = list(drive.frames(8, 11))[-1]
    alone = next(drive.frames(10, 11))
    difference = np.abs(through.left.astype(int) - alone.left)
    assert np.mean(difference) < 3  # the exposure settles again, the drops do not move
