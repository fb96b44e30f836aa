"""The error model of chains: against NumPy, against sampling, there and back."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from tests.builders import covariance_of, forward
from tests.reference import chain_error as oracle
from tests.reference.chain_error import error_of
from tests.reference.graph_search import variance_at

from engram.errors import InputError
from engram.geometry.se3 import SE3, propagate_covariance
from engram.graph.basin import ChainError, PivotedError


def random_covariance(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    scales = np.repeat(10.0 ** rng.uniform([-3, -4], [0, -1]), 3)
    root = rng.normal(size=(6, 6)) * scales[:, None]
    return root @ root.T


@given(st.integers(0, 2**32))
def test_model_of_a_covariance_equals_numpy(seed: int) -> None:
    covariance = random_covariance(seed)
    error = error_of(covariance)
    tau, v, pivot = oracle.pivoted_error(covariance)
    assert error.rotation_var == pytest.approx(v, rel=1e-9)
    assert error.translation_var == pytest.approx(tau, rel=1e-6)
    # The kernel regularises by 1e-9 of the trace.
    np.testing.assert_allclose(error.pivot_in_a, pivot, atol=1e-5 * (1 + np.linalg.norm(pivot)))


@example(0.0, 1e-8, [0.0, 1e-8, 6e-104])  # squares underflow
@given(st.floats(0, 1), st.floats(1e-8, 1), st.lists(st.floats(-50, 50), min_size=3, max_size=3))
def test_covariance_of_a_model_has_that_model(tau: float, v: float, pivot: list[float]) -> None:
    error = PivotedError(tau, v, np.array(pivot))
    again = error_of(error.covariance())
    # The lever's square cancels: digits relative to what it does at the origin.
    scale = tau + v * (1 + float(np.sum(np.square(pivot))))
    assert again.translation_var == pytest.approx(tau, abs=1e-7 * scale)
    assert again.rotation_var == pytest.approx(v, rel=1e-9)
    np.testing.assert_allclose(again.pivot_in_a, pivot, atol=1e-5)


def test_heading_error_of_one_axis_keeps_its_pivot() -> None:
    # A heading error made 100 m back: the pivot is there, and a metre on costs no fresh error.
    yaw = np.zeros((6, 6))
    yaw[4, 4] = 0.01**2
    back = SE3(np.eye(3), np.array([0.0, 0.0, 100.0]))
    error = error_of(propagate_covariance(back.inverse(), 0 * yaw, yaw))
    np.testing.assert_allclose(error.pivot_in_a, [0, 0, -100], atol=1e-4)
    term = (error.translation_var, error.rotation_var, error.pivot_in_a)
    assert variance_at(np.zeros(3), [term]) == pytest.approx(1.0, rel=1e-6)
    assert variance_at(np.array([0, 0, -100.0]), [term]) == pytest.approx(0.0, abs=1e-6)


def test_summed_moments_cover_the_errors_of_sampled_chains() -> None:
    rng = np.random.default_rng(7)
    steps = [forward(1.0, yaw_rad=0.03) for _ in range(60)]
    sigma = np.array([0.02, 0.01, 0.03, 0.001, 0.003, 0.001])
    moments, pose = np.zeros(6), SE3.identity()
    for step in steps:
        error = error_of(np.diag(sigma**2)).seen_from(pose)
        pivot = error.pivot_in_a
        v = error.rotation_var
        moments += [error.translation_var, v, *(v * pivot), v * (pivot @ pivot)]
        pose = pose @ step
    ends = []
    for _ in range(400):
        sample = SE3.identity()
        for step in steps:
            sample = sample @ SE3.exp(rng.normal(0, sigma)) @ step
        ends.append(sample.translation)
    scatter = np.cov(np.array(ends).T)
    whole = ChainError(moments).pivoted(pose.translation)
    term = (whole.translation_var, whole.rotation_var, whole.pivot_in_a)
    predicted = variance_at(pose.translation, [term])
    worst = np.linalg.eigvalsh(scatter)[-1]
    # Never less than the worst axis (400 samples: 7 %), nor wastefully more.
    assert 0.93 * worst <= predicted <= 1.5 * worst


@pytest.mark.parametrize(
    "bad", [np.eye(5), np.full((6, 6), np.inf), np.diag([1.0, 1, 1, 1, 1, -1])]
)
def test_what_is_no_covariance_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(InputError, match="covariance"):
        error_of(bad)


def test_no_uncertainty_is_a_model_too() -> None:
    error = error_of(covariance_of(0.0, 0.0))
    assert (error.translation_var, error.rotation_var) == (0.0, 0.0)
