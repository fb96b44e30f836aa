"""Each fault of a drive is a finding; a healthy drive has none."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from engram.doctor.checks import frames_late, scale_off, turn_ratio, upright
from engram.doctor.examination import DoctorConfig, Evidence, Examination, Facts, Look, align
from engram.doctor.table import (
    CHECKS,
    Diagnosis,
    Finding,
    Severity,
    diagnose,
    fatal_findings,
)
from engram.frontend.features import SideMatches, match_sides
from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import Clock
from engram.odometry.outside import OutsideMotion
from engram.robot.front import Front, stamp_of
from engram.robot.mapping import LookedAhead, stretches
from engram.robot.settings import Settings
from engram.viewing.pictures import side_picture
from engram_lab.bench.data import synthetic_drive
from engram_lab.studies.faults.injected import (
    blurred,
    brightened,
    exchanged,
    frozen,
    halved,
    late_side,
    lowered,
    on_both,
    turned,
)

RNG = np.random.default_rng(1)


@pytest.fixture(scope="module")
def pairs() -> list[StereoPair]:
    return list(synthetic_drive(frames=13, step_m=0.8))


def examined(pairs: Sequence[StereoPair], facts: Facts | None = None) -> Diagnosis:
    front = Front(Settings())
    front.examination.evidence.facts = facts or Facts()
    for pair in pairs:
        if front.clock.take(pair.stamp_ns):
            front.take(pair)
    front.examination.evidence.taken = front.clock.report
    assert front.unfit == front.diagnosis.fatal
    return front.diagnosis


def codes(diagnosis: Diagnosis) -> set[str]:
    return {one.code for one in diagnosis.findings if one.severity is not Severity.NOTE}


def test_a_healthy_drive_has_no_findings(pairs) -> None:
    assert codes(examined(pairs)) == set()


def test_a_robot_at_rest_has_no_findings(pairs) -> None:
    def noisy(image: np.ndarray) -> np.ndarray:
        return np.clip(image + RNG.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)

    rest = [replace(on_both(pairs[0], noisy), stamp_ns=one.stamp_ns) for one in pairs]
    assert codes(examined(rest)) == set()


def each(change: Callable[[StereoPair], StereoPair]) -> Callable[..., list[StereoPair]]:
    return lambda pairs: [change(pair) for pair in pairs]


def resized_without_its_calibration(pair: StereoPair) -> StereoPair:
    smaller = halved(pair, 2.0)
    camera = replace(pair.camera, width=smaller.camera.width, height=smaller.camera.height)
    return replace(smaller, camera=camera)


def test_a_strip_cut_from_the_images_is_no_other_size(pairs) -> None:
    def strip(pair: StereoPair) -> StereoPair:
        rows = 2 * pair.camera.height // 3
        camera = replace(pair.camera, height=rows)
        return replace(pair, left=pair.left[:rows], right=pair.right[:rows], camera=camera)

    assert "principal_point_off" not in codes(examined([strip(pair) for pair in pairs]))


def numbered(pairs: list[StereoPair]) -> list[StereoPair]:
    return [replace(pair, stamp_ns=10**9 * k) for k, pair in enumerate(pairs)]


def later(pairs: list[StereoPair], number: int, by_s: float) -> list[StereoPair]:
    return [
        replace(pair, stamp_ns=pair.stamp_ns + round(by_s * 1e9) * (k >= number))
        for k, pair in enumerate(pairs)
    ]


FAULTS: dict[str, tuple[str, Callable[[list[StereoPair]], list[StereoPair]]]] = {
    "swapped": ("sides_swapped", each(exchanged)),
    "rotated": ("images_rotated", each(lambda one: on_both(one, turned))),
    "upside down": ("upside_down", each(lambda one: exchanged(on_both(one, turned)))),
    "late": (
        "not_synchronised",
        lambda pairs: [one.pair for one in late_side(pairs, 1, 1, RNG)][1:],
    ),
    "rows": ("rows_misaligned", each(lambda one: replace(one, right=lowered(one.right, 2.5)))),
    "rolled": (
        "rows_misaligned",
        each(lambda one: replace(one, right=lowered(one.right, 0, 0.012))),
    ),
    "rows slightly": (
        "rows_slightly_off",
        each(lambda one: replace(one, right=lowered(one.right, 1.0))),
    ),
    "frozen": (
        "frozen_stream",
        lambda pairs: [one.pair for one in frozen(pairs, 5, 6, RNG)],
    ),
    "right frozen": (
        "frozen_stream",
        lambda pairs: [one.pair for one in frozen(pairs, 5, 6, RNG, ("right",))],
    ),
    "one stale": (
        "repeated_images",
        lambda pairs: [one.pair for one in frozen(pairs, 1, 6, RNG)],
    ),
    "dark": ("no_odometry", each(lambda one: on_both(one, lambda i: brightened(i, 0.02)))),
    "bright": ("overexposed", each(lambda one: on_both(one, lambda i: brightened(i, 6)))),
    "one side dark": (
        "sides_exposed_differently",
        each(lambda one: replace(one, right=brightened(one.right, 0.5))),
    ),
    "blurred": ("blurred", each(lambda one: on_both(one, lambda i: blurred(i, 5)))),
    "resized alone": ("principal_point_off", each(resized_without_its_calibration)),
    "small": ("low_resolution", each(lambda one: halved(one, 4.0))),
    "numbered": ("stamps_counted", numbered),
    "backwards": ("stamps_backwards", lambda pairs: later(pairs, 8, -0.5)),
    "repeated": ("stamps_repeated", lambda pairs: later(pairs, 8, -0.1)),
    "stall": ("frame_gaps", lambda pairs: later(pairs, 8, 0.8)),
    "an hour": ("stamp_jump", lambda pairs: later(pairs, 8, 3600)),
    "slow": ("low_frame_rate", lambda pairs: [replace(p, stamp_ns=p.stamp_ns * 4) for p in pairs]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_found(pairs, fault: str) -> None:
    code, inject = FAULTS[fault]
    found = examined(inject(pairs))
    assert code in codes(found)
    (one,) = (finding for finding in found.findings if finding.code == code)
    assert one.cure
    limit = f"{100 * one.limit:.3g}%" if one.unit.startswith("of the") else f"{one.limit:.3g}"
    assert f", limit {limit})" in one.text()


def test_an_exposure_that_hunts_on_one_side_is_no_lag(pairs) -> None:
    bright_at = itertools.cycle([(1.0, 0.3), (1.0, 0.3), (0.3, 1.0), (0.3, 1.0)])
    hunting = [
        replace(one, left=brightened(one.left, left), right=brightened(one.right, right))
        for one, (left, right) in zip(pairs, bright_at, strict=False)
    ]
    found = codes(examined(hunting))
    assert "sides_exposed_differently" in found
    assert "not_synchronised" not in found


def test_consequences_of_swapped_sides_are_not_findings_of_their_own(pairs) -> None:
    assert codes(examined([exchanged(pair) for pair in pairs])) == {"sides_swapped"}


def test_the_way_between_the_instants_of_left_and_right_is_measured(pairs) -> None:
    ways = []
    for before, pair in itertools.pairwise(pairs):
        found = align(match_sides(replace(pair, right=before.right)), pair.camera)
        ways += [] if found is None else [found.forward_m]
    assert np.median(ways) == pytest.approx(-0.8, abs=0.15)


CAMERA = StereoCamera(400.0, 400.0, 255.5, 191.5, 0.2, 512, 384)


def matched(points: np.ndarray, noise_px: float = 0.2) -> SideMatches:
    """Matches of points (N, 3) in the camera's frame, metres."""
    across, down, far = points.T
    pixels = np.column_stack([across / far, down / far]) * CAMERA.fx + [CAMERA.cx, CAMERA.cy]
    shift = np.column_stack([CAMERA.fx * CAMERA.baseline_m / far, np.zeros(len(far))])
    return SideMatches(pixels, shift + RNG.normal(0, noise_px, shift.shape))


def test_a_road_without_a_match_in_the_lower_third_tells_up_from_down() -> None:
    far = RNG.uniform(12, 40, 60)
    height = np.where(np.arange(60) < 10, 1.5, RNG.uniform(-4, 1, 60))
    seen = Evidence(DoctorConfig(), camera=CAMERA)
    points = np.column_stack([RNG.uniform(-6, 6, 60), height, far])
    seen.matches = [(k, matched(points)) for k in range(4)]
    assert (upright(seen) or 0) > 0.5


def test_one_wrong_match_is_no_way_forwards_and_no_misalignment() -> None:
    far = np.column_stack([RNG.uniform(-20, 20, 40), RNG.uniform(-9, 2, 40), np.full(40, 60.0)])
    sound = matched(far)
    pixels = np.vstack([sound.pixels, [[300.0, 330.0]]])
    wrong = SideMatches(pixels, np.vstack([sound.shift, [[60.0, -14.0]]]))
    found = align(wrong, CAMERA)
    assert found is not None
    assert abs(found.forward_m) < max(4 * found.sigma_m, 0.05)
    assert found.rms_px < 0.5


AHEAD, ASIDE, AT_REST = np.array([[0.1, 0.0, 0.5], [0.5, 0.0, 0.1], [0.0, 0.0, 0.0]])


def late_rows(frames: int, moved: np.ndarray) -> Evidence:
    """24 frames, the right side some frames late."""
    shown = np.cumsum(RNG.normal(0, 1, (30, 48)), axis=0).astype(np.float32)
    seen = Evidence(DoctorConfig(), camera=CAMERA, odometry=[True] * 24, sigma_m=[0.0] * 24)
    seen.outside = [None] * 24
    for k in range(24):
        rows = shown[[k + frames, k]] + RNG.normal(0, 0.5, (2, 48)).astype(np.float32)
        seen.looks.append(Look((100, 100), 0, 0, (False, False), (40, 40), rows))
        seen.stamps_ns.append(k * 10**8 + 7)
        seen.first.append(k == 0)
        seen.moved.append(SE3(np.eye(3), moved) if k else None)
    return seen


@pytest.mark.parametrize(
    ("late", "moved", "found"), [(0, AHEAD, 0), (3, AHEAD, 3), (3, ASIDE, None), (3, AT_REST, None)]
)
def test_a_late_side_shows_in_the_rows_of_a_robot_that_drives(late: int, moved, found) -> None:
    assert frames_late(late_rows(late, moved)) == found


def test_rows_that_are_misaligned_tell_no_lag() -> None:
    seen = late_rows(1, AHEAD)
    assert codes(diagnose(seen)) == {"not_synchronised"}
    points = np.column_stack(
        [RNG.uniform(-9, 9, 60), RNG.uniform(-4, 1, 60), RNG.uniform(9, 30, 60)]
    )
    for k in range(4):
        sound = matched(points)
        seen.matches.append((k, SideMatches(sound.pixels, sound.shift + np.array([0.0, 3.0]))))
    assert codes(diagnose(seen)) == {"rows_misaligned"}
    assert [one.code for one in fatal_findings(seen)] == ["rows_misaligned"]


@pytest.mark.parametrize(("sigma_m", "off"), [(0.02, 0.12), (0.3, None)])
def test_odometry_that_is_unsure_of_its_steps_tells_no_scale(sigma_m: float, off) -> None:
    step, told = (SE3(np.eye(3), np.array([0, 0, one])) for one in (0.56, 0.5))
    seen = Evidence(DoctorConfig(), moved=[step] * 24, outside=[told] * 24)
    seen.sigma_m = [sigma_m] * 24
    assert scale_off(seen) == (off and pytest.approx(off))


def test_a_scale_is_told_by_the_median_of_ways_unless_they_spread_too_far() -> None:
    def off(ratios: list[float]) -> float | None:
        told = [SE3(np.eye(3), np.array([0, 0, 2.0]))] * len(ratios)
        moved = [SE3(np.eye(3), np.array([0, 0, 2.0 * one])) for one in ratios]
        seen = Evidence(DoctorConfig(), moved=list(moved), outside=list(told))
        seen.sigma_m = [0.1] * len(ratios)
        return scale_off(seen)

    assert off([1.1, 1.15, 1.2, 1.16, 1.14] * 2) == pytest.approx(0.15)
    assert off([0.8, 1.15, 1.5, 1.16, 0.9] * 2) is None
    assert off([1.15] * 2) is None


def test_a_picture_shows_in_red_what_is_wrong_and_no_chance_matches(pairs) -> None:
    left, right = pairs[0].left.copy(), pairs[0].right.copy()
    left[40:120, 300:460] = right[70:150, 700:860] = RNG.integers(0, 255, (80, 160))

    def red(pair: StereoPair) -> bool:
        return bool(
            (side_picture(pair)[..., 2].astype(int) - side_picture(pair)[..., 0] > 99).any()
        )

    assert not red(replace(pairs[0], left=left, right=right))
    assert red(exchanged(pairs[0]))


def test_an_unknown_hour_matters_where_missions_by_hour_need_it(pairs) -> None:
    needed = Facts(Clock.UNKNOWN, by_hour=True)
    assert codes(examined(pairs, needed)) == {"clock_unknown"}
    known = Facts(Clock.UTC, zone="Europe/London", by_hour=True)
    assert codes(examined(pairs, known)) == set()


def test_no_more_frames_are_looked_at_than_asked_for(pairs) -> None:
    front = Front(Settings(doctor=DoctorConfig(frames=4)))
    for pair in pairs[:6]:
        front.take(pair)
    assert front.diagnosis.frames == 4
    assert len(front.examination.evidence.matches) == 2


def test_nothing_is_said_of_no_frames() -> None:
    assert diagnose(Examination().evidence).findings == ()


def test_every_check_has_a_limit_a_cure_and_one_severity_for_its_code() -> None:
    severities: dict[str, Severity] = {}
    for check in CHECKS:
        assert isinstance(check.limit, int | float) or hasattr(DoctorConfig(), check.limit)
        assert check.message
        assert check.cure
        assert severities.setdefault(check.code, check.severity) is check.severity
        assert set(check.explains) <= {one.code for one in CHECKS}


@given(length=st.integers(1, 5000), most=st.integers(1, 300))
def test_stretches_are_parts_of_the_drive_without_overlap(length: int, most: int) -> None:
    frames = [number for stretch in stretches(length, most) for number in stretch]
    assert frames == sorted(set(frames))
    assert 0 <= frames[0] <= frames[-1] < length
    assert len(frames) <= most


class Odometer:
    """Motion from outside that makes every step too long, and is read once, in order."""

    def __init__(self, factor: float) -> None:
        self.factor = factor
        self.read_to_ns = 0

    def between(self, start_ns: int, end_ns: int) -> OutsideMotion:
        assert start_ns >= self.read_to_ns, "read twice"
        self.read_to_ns = end_ns
        step = SE3(np.eye(3), np.array([0.0, 0.0, 0.8 * self.factor]))
        return OutsideMotion(step, (end_ns - start_ns) / 1e9)


class Moved(list[StereoPair]):
    """A drive with motion from outside."""

    factor = 1.0

    def motion(self) -> Odometer:
        return Odometer(self.factor)


@pytest.mark.parametrize(("factor", "found"), [(1.0, set()), (1.12, {"scale_off"})])
def test_a_wrong_focal_length_shows_against_motion_from_outside(
    pairs, factor: float, found: set[str]
) -> None:
    drive, front = Moved(pairs), Front(Settings())
    drive.factor = factor
    with closing(LookedAhead(front, drive)):  # type: ignore[arg-type]
        assert codes(front.diagnosis) == found
        cures = {one.cure for one in front.diagnosis.findings if one.code in found}
        assert all("is in metres" in cure for cure in cures)


def test_motion_from_outside_goes_on_behind_the_frames_that_were_taken_ahead(pairs) -> None:
    front = Front(Settings(doctor=DoctorConfig(frames=4)))
    with closing(LookedAhead(front, Moved(pairs))) as ahead:  # type: ignore[arg-type]
        source, taken = ahead.motion(), list(ahead)
        assert source is not None
        assert [stamp_of(one) for one in taken] == [pair.stamp_ns for pair in pairs]
        assert source.between(pairs[2].stamp_ns, pairs[3].stamp_ns) is None
        assert source.between(pairs[3].stamp_ns, pairs[4].stamp_ns) is not None


@pytest.mark.parametrize(
    ("turn_rad", "factor", "found"),
    [
        (0.02, 1.0, pytest.approx(1.0)),
        (0.02, np.rad2deg(1.0), pytest.approx(57.3, abs=0.1)),
        (1e-4, 3000.0, None),  # a straight road says nothing of the unit
    ],
)
def test_turns_in_degrees_are_told(turn_rad: float, factor: float, found) -> None:
    turn = SE3.exp([0.0, 0.0, 0.8, 0.0, turn_rad, 0.0])
    seen = Evidence(DoctorConfig(), moved=[turn] * 24, turned_rad=[factor * turn_rad] * 24)
    assert turn_ratio(seen) == found
    (check,) = [one for one in CHECKS if one.code == "turns_in_degrees"]
    assert isinstance(check.finding(seen), Finding) == (factor > 10 and found is not None)


@pytest.mark.parametrize("factor", [1.0, np.rad2deg(1.0)])
def test_the_front_compares_the_gyroscope_with_odometry(pairs, factor: float) -> None:
    front = Front(Settings())
    rates = factor * np.array([0.0, 0.2, 0.0])
    for number, pair in enumerate(pairs):
        turned = SE3.exp(np.r_[np.zeros(3), 0.1 * rates])
        front.take(pair, OutsideMotion(turned, 0.1, False, rates) if number else None)
    found = front.examination.evidence.turned_rad
    assert found[0] is None
    assert found[1:] == pytest.approx([0.1 * float(np.linalg.norm(rates))] * (len(pairs) - 1))


def test_the_clock_names_only_what_is_missing(pairs) -> None:
    for facts, cure in (
        (Facts(clock=Clock.UTC), "give drive.zone"),
        (Facts(clock=Clock.RELATIVE, zone="Europe/London"), "give drive.recorded_at"),
        (Facts(clock=Clock.RELATIVE), "give drive.recorded_at and drive.zone"),
    ):
        (note,) = [one for one in examined(pairs, facts).findings if one.code == "clock_unstated"]
        assert note.cure == f"for downloads by hour {cure}"


def test_stamps_in_another_unit_do_not_jump(pairs) -> None:
    slow = [replace(one, stamp_ns=one.stamp_ns * 1000) for one in pairs]
    found = examined(slow).findings
    assert [one.code for one in found if one.severity is Severity.WARNING] == ["low_frame_rate"]
    assert "milliseconds" in found[0].cure
