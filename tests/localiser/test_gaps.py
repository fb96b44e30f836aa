"""Motion over the frames at which odometry fails."""

import numpy as np
import pytest

from engram.errors import ConfigError
from engram.geometry.se3 import SE3
from engram.odometry.motion import GapConfig, GapFiller, Motion, driven_steps_m
from engram.odometry.step import OdometryStatus, OdometryStep

FIRST = OdometryStep(OdometryStatus.FIRST)
BLIND = OdometryStep(OdometryStatus.NO_CONSENSUS)
DARK = OdometryStep(OdometryStatus.UNUSABLE_FRAME)
MS = 1_000_000


def ahead(metres: float) -> OdometryStep:
    pose = SE3(np.eye(3), np.array([0.0, 0.0, metres]))
    return OdometryStep(OdometryStatus.OK, pose, np.eye(6) * 1e-6, 100)


def without_drift() -> GapFiller:
    return GapFiller(GapConfig(drift_m=0.0))


def test_what_was_measured_passes_through() -> None:
    gaps = without_drift()
    assert gaps.motion(FIRST, 0).prev_from_curr is None
    step = ahead(0.5)
    motion = gaps.motion(step, 100 * MS)
    assert motion.prev_from_curr is step.prev_from_curr
    np.testing.assert_array_equal(motion.covariance, step.covariance)
    assert motion.guessed_m == 0


def test_a_missing_step_goes_on_at_the_last_speed_for_as_long_as_it_took() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    gaps.motion(ahead(0.5), 100 * MS)
    guess = gaps.motion(BLIND, 300 * MS)
    np.testing.assert_allclose(guess.prev_from_curr.translation, [0, 0, 1.0])
    assert guess.guessed_m == pytest.approx(0.5, abs=0.01)
    np.testing.assert_allclose(np.diag(guess.covariance)[:3], guess.guessed_m**2)
    again = gaps.motion(BLIND, 400 * MS)
    np.testing.assert_allclose(again.prev_from_curr.translation, [0, 0, 0.5])
    # Errors of one gap add up: half of its 1.5 m.
    assert np.hypot(guess.guessed_m, again.guessed_m) == pytest.approx(0.75, abs=0.01)


def test_a_bend_goes_on_as_a_bend() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    step = SE3.exp([0.0, 0.0, 0.5, 0.0, 0.1, 0.0])
    gaps.motion(OdometryStep(OdometryStatus.OK, step, np.eye(6) * 1e-6, 100), 100 * MS)
    guess = gaps.motion(BLIND, 300 * MS)
    np.testing.assert_allclose(guess.prev_from_curr.matrix(), (step @ step).matrix(), atol=1e-12)


def test_an_unusable_frame_says_nothing_and_the_next_step_spans_it() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    gaps.motion(ahead(0.5), 100 * MS)
    assert gaps.motion(DARK, 200 * MS).prev_from_curr is None
    gaps.motion(ahead(1.0), 300 * MS)  # spans both: still 5 m/s
    guess = gaps.motion(BLIND, 400 * MS)
    np.testing.assert_allclose(guess.prev_from_curr.translation, [0, 0, 0.5])


@pytest.mark.parametrize("stamp_ns", [-5 * MS, 100 * MS])
def test_nothing_is_guessed_without_a_speed_or_by_a_clock_that_does_not_go_on(
    stamp_ns: int,
) -> None:
    fresh = without_drift()
    fresh.motion(FIRST, 0)
    assert fresh.motion(BLIND, 100 * MS).guessed_m == np.inf
    backwards = without_drift()
    backwards.motion(FIRST, 0)
    backwards.motion(ahead(0.5), 100 * MS)
    assert backwards.motion(BLIND, stamp_ns).guessed_m == np.inf


def test_one_wrong_step_before_a_gap_does_not_carry_the_robot_away() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    for i in range(1, 5):
        gaps.motion(ahead(0.5), i * 100 * MS)
    gaps.motion(ahead(3.0), 500 * MS)
    guess = gaps.motion(BLIND, 600 * MS)
    np.testing.assert_allclose(guess.prev_from_curr.translation, [0, 0, 0.5])


def test_a_measurement_that_is_vaguer_than_the_guess_is_none() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    gaps.motion(ahead(0.5), 100 * MS)
    pose = SE3(np.eye(3), np.array([0.0, 0.0, 14.0]))
    wild = OdometryStep(OdometryStatus.OK, pose, np.eye(6) * 2.0**2, 12)
    motion = gaps.motion(wild, 200 * MS)
    np.testing.assert_allclose(motion.prev_from_curr.translation, [0, 0, 0.5])
    assert motion.guessed_m > 0
    assert gaps.motion(ahead(0.6), 300 * MS).guessed_m == 0


def test_a_robot_that_sets_off_is_believed_in_the_end() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    for i in range(1, 6):
        gaps.motion(ahead(0.0), i * 100 * MS)
    vague = OdometryStep(
        OdometryStatus.OK, SE3(np.eye(3), np.array([0.0, 0.0, 0.5])), np.eye(6) * 0.1**2, 12
    )
    motions = [gaps.motion(vague, i * 100 * MS) for i in range(6, 20)]
    assert [one.guessed_m > 0 for one in motions[:5]] == [True] * 5
    assert motions[5].guessed_m == 0
    assert all(one.guessed_m == 0 for one in motions[8:])


def test_what_was_driven_blindly_counts() -> None:
    odometry = [FIRST, ahead(0.5), BLIND, DARK, ahead(1.0)]
    stamps_ns = [0, 100 * MS, 200 * MS, 300 * MS, 400 * MS]
    gaps = without_drift()
    motions = [gaps.motion(*one) for one in zip(odometry, stamps_ns, strict=True)]
    np.testing.assert_allclose(driven_steps_m(motions, stamps_ns), [0.0, 0.5, 0.5, 0.5, 0.5])


def test_way_past_frames_of_no_use_is_theirs() -> None:
    """By time; before the first usable frame nothing is known of it, nor after the last."""
    far, near = (Motion(ahead(m), ahead(m).prev_from_curr) for m in (2.0, 0.5))
    dark = Motion(DARK)
    motions = [dark, Motion(FIRST), dark, dark, far, near, dark]
    stamps_ns = [stamp * MS for stamp in (0, 100, 200, 400, 500, 600, 700)]
    found = driven_steps_m(motions, stamps_ns)
    np.testing.assert_allclose(found, [0, 0, 0.5, 1.0, 0.5, 0.5, 0], atol=1e-12)


def going(gaps: GapFiller, steps: int = 3) -> int:
    """Five metres a second for so many tenths of a second; the stamp of the last."""
    gaps.motion(FIRST, 0)
    for number in range(1, steps + 1):
        assert gaps.motion(ahead(0.5), number * 100 * MS).guessed_m == 0
    return steps * 100 * MS


@pytest.mark.parametrize(("metres", "believed"), [(0.41, True), (0.39, False), (0.0, False)])
def test_a_robot_does_not_stop_from_one_frame_to_the_next(metres: float, believed: bool) -> None:
    gaps = without_drift()
    now = going(gaps)
    motion = gaps.motion(ahead(metres), now + 100 * MS)  # 10 m/s² are 0.1 m here
    assert (motion.guessed_m == 0) is believed
    assert motion.prev_from_curr.distance_m == pytest.approx(metres if believed else 0.5)


def test_what_is_not_believed_at_once_is_believed_once_it_is_possible() -> None:
    gaps = without_drift()
    now = going(gaps)
    believed = [gaps.motion(ahead(0.0), now + k * 100 * MS).guessed_m == 0 for k in range(1, 8)]
    assert believed == [False] * 4 + [True] * 3  # from 5 m/s in half a second


def test_vague_measurements_are_given_the_benefit_of_their_doubt() -> None:
    gaps = without_drift()
    now = going(gaps)
    pose = SE3(np.eye(3), np.array([0.0, 0.0, 0.2]))
    vague = OdometryStep(OdometryStatus.OK, pose, np.eye(6) * 0.1**2, 20)
    assert gaps.motion(vague, now + 100 * MS).guessed_m == 0


def test_a_speed_that_hardly_began_to_be_known_forbids_nothing() -> None:
    gaps = without_drift()
    now = going(gaps, steps=2)
    assert gaps.motion(ahead(2.0), now + 100 * MS).guessed_m == 0


def test_steps_among_missing_ones_are_worth_less_than_odometry_says() -> None:
    gaps = without_drift()
    now = going(gaps)
    for k in (1, 2):
        gaps.motion(BLIND, now + k * 100 * MS)
    step = ahead(0.5)
    doubted = gaps.motion(step, now + 300 * MS)
    assert doubted.guessed_m == 0
    assert doubted.prev_from_curr is step.prev_from_curr
    # Two of ten steps are missing: one measured step in five may be wrong by all its length.
    expected = step.covariance.diagonal()[:3] + 0.2 * 0.5**2
    np.testing.assert_allclose(doubted.covariance.diagonal()[:3], expected)
    assert (doubted.covariance.diagonal()[3:] > step.covariance.diagonal()[3:]).all()
    for k in range(4, 14):
        last = gaps.motion(step, now + k * 100 * MS)
    np.testing.assert_array_equal(
        last.covariance, step.covariance
    )  # ten good steps later it is forgotten


def test_what_was_driven_before_the_first_measurement_is_made_up_for() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    assert [gaps.motion(BLIND, k * 100 * MS).prev_from_curr.distance_m for k in (1, 2, 3)] == [
        0
    ] * 3
    motion = gaps.motion(ahead(0.5), 400 * MS)
    np.testing.assert_allclose(motion.prev_from_curr.translation, [0, 0, 2.0], atol=1e-12)
    assert motion.guessed_m == 0
    # Half of the 1.5 m that nobody saw, and three missing of the last ten steps.
    sigma_m = np.sqrt(motion.covariance[2, 2])
    assert sigma_m > np.hypot(0.75, 0.5 * np.sqrt(0.3))
    assert sigma_m < 1.2
    # Once.
    again = gaps.motion(ahead(0.5), 500 * MS)
    np.testing.assert_allclose(again.prev_from_curr.translation, [0, 0, 0.5])


def test_a_vague_first_measurement_makes_up_for_much_and_says_that_it_is_vague() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    gaps.motion(BLIND, 1000 * MS)
    pose = SE3(np.eye(3), np.array([0.0, 0.0, 1.0]))
    vague = OdometryStep(OdometryStatus.OK, pose, np.eye(6) * 0.3**2, 12)
    motion = gaps.motion(vague, 1100 * MS)
    assert motion.prev_from_curr.distance_m == pytest.approx(11.0)
    # Ten steps, each wrong in the same way as the one that was measured.
    assert np.sqrt(motion.covariance[2, 2]) > 3.0


def test_a_clock_that_goes_back_before_the_first_measurement_moves_nobody() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 100 * MS)
    gaps.motion(BLIND, 0)
    motion = gaps.motion(ahead(0.5), 100 * MS)
    np.testing.assert_allclose(motion.prev_from_curr.translation, [0, 0, 0.5])


def turning(degrees: float, sigma_m: float, sigma_deg: float) -> OdometryStep:
    """Half a metre ahead and a turn, so well measured."""
    pose = SE3.exp([0.0, 0.0, 0.5, 0.0, np.deg2rad(degrees), 0.0])
    covariance = np.diag([sigma_m**2] * 3 + [np.deg2rad(sigma_deg) ** 2] * 3)
    return OdometryStep(OdometryStatus.OK, pose, covariance, 20)


def test_a_vague_step_before_a_gap_hardly_turns_the_robot() -> None:
    gaps = without_drift()
    now = going(gaps)
    gaps.motion(BLIND, now + 100 * MS)
    vague = gaps.motion(turning(8.0, 0.3, 4.0), now + 200 * MS)
    assert vague.guessed_m == 0  # the best that is known of that step
    guess = gaps.motion(BLIND, now + 300 * MS)
    assert 0.0 < np.rad2deg(guess.prev_from_curr.angle_rad) < 1.0
    sharp = without_drift()
    now = going(sharp)
    sharp.motion(turning(8.0, 0.01, 0.1), now + 100 * MS)
    guess = sharp.motion(BLIND, now + 200 * MS)
    assert np.rad2deg(guess.prev_from_curr.angle_rad) == pytest.approx(8.0, abs=0.1)


def test_a_vague_speed_is_learnt_only_where_none_or_an_old_one_is_known() -> None:
    vague = OdometryStep(
        OdometryStatus.OK, SE3(np.eye(3), np.array([0.0, 0.0, 0.3])), np.eye(6) * 0.1**2, 20
    )
    fresh = without_drift()
    fresh.motion(FIRST, 0)
    fresh.motion(vague, 100 * MS)
    assert fresh.motion(BLIND, 200 * MS).prev_from_curr.distance_m == pytest.approx(0.3)
    gaps = without_drift()
    now = going(gaps)
    guesses_m = []
    for step in range(16):
        gaps.motion(vague, now + 200 * step * MS + 100 * MS)
        guess = gaps.motion(BLIND, now + 200 * step * MS + 200 * MS)
        guesses_m.append(guess.prev_from_curr.distance_m)
    np.testing.assert_allclose(guesses_m[:5], 0.5)
    np.testing.assert_allclose(guesses_m[-3:], 0.3)


def test_a_first_step_that_is_far_off_is_forgotten_once_better_ones_came() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    wild = SE3(np.eye(3), np.array([0.0, 0.0, 14.0]))
    gaps.motion(OdometryStep(OdometryStatus.OK, wild, np.eye(6) * 3.0**2, 12), 100 * MS)
    good = SE3(np.eye(3), np.array([0.0, 0.0, 0.5]))
    vague = OdometryStep(OdometryStatus.OK, good, np.eye(6) * 0.2**2, 20)
    for k in range(2, 10):
        motion = gaps.motion(vague, k * 100 * MS)
    np.testing.assert_array_equal(
        motion.covariance, vague.covariance
    )  # nothing is missing: it is not doubted
    assert gaps.motion(BLIND, 1000 * MS).prev_from_curr.distance_m == pytest.approx(0.5)


def test_a_robot_that_seems_to_stop_among_missing_steps_is_doubted_by_its_speed() -> None:
    gaps = without_drift()
    now = going(gaps)
    motions = [gaps.motion(ahead(0.0), now + k * 100 * MS) for k in range(1, 11)]
    stood = [one for one in motions if one.guessed_m == 0]
    assert len(stood) == 6  # four were impossible
    # Four of ten steps are missing, and each of them was half a metre.
    sigma_m = [np.sqrt(one.covariance[2, 2]) for one in stood]
    np.testing.assert_allclose(sigma_m, 0.5 * np.sqrt(0.4), rtol=1e-3)


def test_while_the_camera_is_dark_the_guess_goes_on_and_grows_less_certain() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    for k in range(1, 6):
        gaps.motion(ahead(0.5), k * 100 * MS)
    dark = [gaps.motion(DARK, (500 + later) * MS) for later in (100, 500, 2000)]
    assert all(one.prev_from_curr is None for one in dark)
    guesses = [one.ahead for one in dark if one.ahead is not None]
    assert [pose.distance_m for pose, _ in guesses] == pytest.approx([0.5, 2.5, 10.0])
    sigmas_m = [float(np.sqrt(covariance[2, 2])) for _, covariance in guesses]
    assert sigmas_m == sorted(sigmas_m)
    assert 5.0 < sigmas_m[-1] < 6.0


def test_a_robot_at_rest_may_have_driven_off_while_nothing_was_seen() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    for k in range(1, 6):
        gaps.motion(ahead(0.0), k * 100 * MS)
    motion = gaps.motion(DARK, 5000 * MS)
    assert motion.ahead is not None
    # 0.5 m/s² for 4 s.
    assert np.sqrt(motion.ahead[1][2, 2]) == pytest.approx(4.0, rel=0.01)


def test_how_far_a_guess_is_trusted_is_a_setting() -> None:
    def guessed_m(config: GapConfig) -> float:
        gaps = GapFiller(config)
        gaps.motion(FIRST, 0)
        gaps.motion(ahead(0.5), 100 * MS)
        return gaps.motion(BLIND, 300 * MS).guessed_m

    assert guessed_m(GapConfig(sigma_per_m=1.0)) == pytest.approx(2 * guessed_m(GapConfig()), 0.02)
    with pytest.raises(ConfigError, match="sigma_per_m"):
        GapConfig(sigma_per_m=0.0)


def vague(metres: float, sigma_m: float) -> OdometryStep:
    pose = SE3(np.eye(3), np.array([0.0, 0.0, metres]))
    return OdometryStep(OdometryStatus.OK, pose, np.eye(6) * sigma_m**2, 40)


def test_errors_of_vague_steps_and_guesses_in_a_row_add_up() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    for i in range(1, 6):
        gaps.motion(ahead(0.7), i * 100 * MS)
    rows = [vague(0.3, 0.3), vague(0.3, 0.3), BLIND, ahead(0.7), vague(0.3, 0.3)]
    motions = [gaps.motion(one, (6 + i) * 100 * MS) for i, one in enumerate(rows)]
    along_m2 = [one.covariance[2, 2] for one in motions]
    doubted_m2 = along_m2[4] - 0.3**2 * (1 + 2 * 0.95 / 0.3)  # a step of the newest ten is missing
    assert along_m2[0] == pytest.approx(0.3**2)
    assert np.sqrt(sum(along_m2[:2])) == pytest.approx(0.6)
    # Half of 0.7 m, which is what odometry last measured well, and not of the 0.3 m since.
    assert np.sqrt(sum(along_m2[:3])) == pytest.approx(0.6 + 0.35, abs=0.01)
    assert doubted_m2 == pytest.approx(0.1 * 0.7**2, rel=1e-6)  # one sharp step ends no run


def test_three_sharp_steps_end_a_run_of_vague_ones() -> None:
    gaps = without_drift()
    gaps.motion(FIRST, 0)
    steps = [vague(0.7, 0.3)] * 8 + [ahead(0.7)] * 3 + [vague(0.7, 0.3)]
    motions = [gaps.motion(one, (i + 1) * 100 * MS) for i, one in enumerate(steps)]
    assert motions[7].covariance[2, 2] > 10 * 0.3**2
    assert motions[11].covariance[2, 2] == pytest.approx(0.3**2)
