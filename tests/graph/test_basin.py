"""The match basin: prior, learning, radius."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import isotonic_regression
from tests.reference import basin as reference

from engram.errors import InputError
from engram.graph.basin import BasinCounts, MatchBasin, _falling, count_attempts, prior_basin_m
from engram.graph.model import Attempt
from engram.testing.contracts import make_node

NODE = make_node(0, 0).id


def attempt(iteration, along_m, accepted, across_m=0.0, sigma_m=0.1) -> Attempt:
    return Attempt(
        iteration, NODE, NODE, along_m, across_m, 0.0, sigma_m, 0.01, accepted, 30, 0, "path"
    )


def count(log: list[Attempt], experiences=None, drives=None) -> BasinCounts:
    """Counts of attempts; all of one experience and one drive where nothing else is said."""
    alike = np.zeros(len(log), np.int64)
    return count_attempts(
        alike if drives is None else np.array(drives, np.int64),
        alike if experiences is None else np.array(experiences, np.int64),
        np.array([one.iteration for one in log], np.int64),
        (np.array([one.along_m for one in log]), np.array([one.across_m for one in log])),
        np.array([one.sigma_m for one in log]),
        np.array([one.accepted for one in log], np.bool_),
    )


def simulated(rng, basin_along_m: float, basin_across_m: float, count: int) -> list[Attempt]:
    """Attempts that succeed inside an ellipse; each iteration also matches at no distance."""
    log = []
    for iteration in range(count):
        log.append(attempt(iteration, 0.0, True))
        along, across = rng.uniform(-12, 12), rng.uniform(-0.9, 0.9)
        if rng.random() < 0.5:
            along, across = rng.uniform(-0.9, 0.9), rng.uniform(-12, 12)
        success = (along / basin_along_m) ** 2 + (across / basin_across_m) ** 2 < 1
        log.append(attempt(iteration, along, success, across))
    return log


@pytest.mark.parametrize(("focal_px", "basin_m"), [(256.0, 2.0), (707.0, 8.0)])
def test_prior_is_the_specified_one(focal_px: float, basin_m: float) -> None:
    assert prior_basin_m(focal_px) == pytest.approx(basin_m)
    # Read off a curve binned by half a metre.
    assert MatchBasin.of(focal_px).basin_m == pytest.approx(basin_m, abs=0.02)


def test_learns_the_basin_of_each_direction_whatever_the_prior() -> None:
    log = simulated(np.random.default_rng(0), 5.0, 3.0, 4000)
    counts = count(log)
    for focal_px in (256.0, 707.0):
        basin = MatchBasin.of(focal_px, counts)
        assert basin.basin_m == pytest.approx(5.0, abs=0.5)
        across = np.arange(0, 10, 0.05)
        reach = across[basin.success_rate(np.zeros_like(across), across) >= 0.6].max()
        assert reach == pytest.approx(3.0, abs=0.5)


@given(st.integers(0, 2**32), st.integers(1, 60), st.sampled_from([1, 3, 16]))
def test_isotonic_regression_is_scipys_to_the_bit(seed: int, count: int, digits: int) -> None:
    rng = np.random.default_rng(seed)
    values = np.round(np.linspace(1, 0, count) + rng.normal(0, 0.2, count), digits)
    weights = 10.0 + rng.integers(0, 40, count)
    expected = isotonic_regression(values, weights=weights, increasing=False).x
    assert _falling(values, weights).tobytes() == expected.tobytes()


@given(st.integers(0, 2**32), st.floats(150, 1000))
def test_success_rate_falls_with_distance(seed: int, focal_px: float) -> None:
    rng = np.random.default_rng(seed)
    attempts = rng.integers(0, 50, (2, 48))
    basin = MatchBasin.of(focal_px, BasinCounts(attempts, rng.integers(0, attempts + 1)))
    offsets = np.linspace(0, 30, 200)
    for rates in (
        basin.success_rate(offsets, 0 * offsets),
        basin.success_rate(0 * offsets, offsets),
    ):
        assert (np.diff(rates) <= 1e-12).all()
        assert ((rates >= 0) & (rates <= 1)).all()


def test_experiences_that_did_not_match_lately_say_nothing() -> None:
    log = [attempt(0, 1.0, False), attempt(0, 1.0, True), attempt(10, 3.0, False)]
    log += [attempt(11, 3.0, False), attempt(12, 3.0, False, sigma_m=2.0)]
    counts = count(log, [0, 1, 1, 1, 1])
    # Only the failure ten iterations after the match counts: not the match itself, not the other
    # experience, not eleven iterations after, not the vague prediction.
    assert counts.attempts[0].sum() == 1
    assert counts.attempts[0, 6] == 1
    assert counts.successes.sum() == 0


def test_a_match_does_not_vouch_for_its_own_iteration() -> None:
    log = [attempt(4, 0.2, True), attempt(4, 1.2, False), attempt(5, 1.2, True)]
    counts = count(log)
    assert counts.attempts[0].sum() == counts.successes[0].sum() == 1


made_attempts = st.builds(
    attempt,
    iteration=st.integers(0, 40),
    along_m=st.floats(-30, 30, width=32),
    accepted=st.booleans(),
    across_m=st.sampled_from([0.0, 1.0, 1.5, -7.0]),
    sigma_m=st.sampled_from([0.1, 1.0, 1.1]),
)


@given(st.lists(st.tuples(made_attempts, st.integers(0, 3), st.integers(0, 2)), max_size=40))
def test_counting_all_drives_at_once_is_counting_one_attempt_after_another(made) -> None:
    made.sort(key=lambda one: (one[2], one[0].iteration))
    counts = count(*([one[k] for one in made] for k in range(3)))
    expected = np.zeros((2, 2, 48), int)
    for drive in range(3):
        log = [one[0] for one in made if one[2] == drive]
        expected += reference.counted(log, [one[1] for one in made if one[2] == drive])
    np.testing.assert_array_equal([counts.attempts, counts.successes], expected)


def test_search_radius_grows_with_basin_and_uncertainty() -> None:
    narrow, wide = MatchBasin.of(256.0), MatchBasin.of(707.0)
    assert narrow.search_radius_m(0.5) == 8.0
    assert wide.search_radius_m(1.0) == pytest.approx(wide.basin_m + 2.0)
    assert narrow.search_radius_m(50.0, most_m=30.0) == pytest.approx(30.0)
    assert wide.search_radius_m(50.0, most_m=1.0) == pytest.approx(max(8.0, wide.basin_m))


def test_senseless_focal_length_is_refused() -> None:
    with pytest.raises(InputError, match="focal length"):
        MatchBasin.of(0.0)
