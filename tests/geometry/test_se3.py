"""SE(3) laws, also near identity and near π."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from engram.errors import InputError
from engram.geometry.se3 import SE3, propagate_covariance

scales = st.sampled_from([1e-9, 1e-5, 1e-4, 1e-2, 1.0])
directions = arrays(np.float64, 6, elements=st.floats(-1, 1)).filter(
    lambda vector: np.linalg.norm(vector[3:]) > 1e-3
)


@st.composite
def tangents(draw: st.DrawFn) -> np.ndarray:
    return draw(scales) * draw(directions)


@given(tangents())
def test_log_undoes_exp(tangent: np.ndarray) -> None:
    np.testing.assert_allclose(SE3.exp(tangent).log(), tangent, atol=1e-12, rtol=1e-9)


@given(tangents(), tangents(), arrays(np.float64, (5, 3), elements=st.floats(-10, 10)))
def test_chaining_transforms_chains_their_action(a, b, points) -> None:
    a_from_b, b_from_c = SE3.exp(a), SE3.exp(b)
    np.testing.assert_allclose(
        (a_from_b @ b_from_c) @ points, a_from_b @ (b_from_c @ points), atol=1e-12
    )


@given(tangents())
def test_inverse_composes_to_identity(tangent) -> None:
    transform = SE3.exp(tangent)
    np.testing.assert_allclose((transform @ transform.inverse()).matrix(), np.eye(4), atol=1e-12)


@given(tangents(), tangents())
def test_adjoint_carries_tangents(a, b) -> None:
    transform = SE3.exp(a)
    left = transform @ SE3.exp(b)
    right = SE3.exp(transform.adjoint() @ b) @ transform
    np.testing.assert_allclose(left.matrix(), right.matrix(), atol=1e-11)


@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-8, np.pi - 1e-4, np.pi - 2e-3])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0.6, 0, -0.8)])
def test_log_near_half_a_turn(angle: float, axis: tuple[float, ...]) -> None:
    tangent = np.concatenate([[1.0, -2.0, 3.0], angle * np.array(axis)])
    transform = SE3.exp(tangent)
    # At π the axis has two signs: compare the transforms. 1e-7: the sine has lost half its digits.
    np.testing.assert_allclose(SE3.exp(transform.log()).matrix(), transform.matrix(), atol=1e-7)


@given(tangents())
def test_quaternion_round_trip(tangent) -> None:
    transform = SE3.exp(tangent)
    again = SE3.from_quaternion(transform.quaternion_wxyz(), transform.translation)
    np.testing.assert_allclose(again.matrix(), transform.matrix(), atol=1e-12)


@given(tangents())
def test_a_stored_matrix_comes_back_to_the_bit(tangent) -> None:
    transform = SE3.exp(tangent)
    np.testing.assert_array_equal(SE3.from_matrix(transform.matrix()).matrix(), transform.matrix())


def test_a_rough_rotation_is_projected() -> None:
    rough = np.eye(4)
    rough[0, 1] = 1e-4
    rotation = SE3.from_matrix(rough).rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)


def test_renormalising_squares_what_is_left_of_skew() -> None:
    rng = np.random.default_rng(4)
    skewed = SE3.exp([1, 2, 3, 0.5, -0.4, 2.0])
    skewed = SE3(skewed.rotation + rng.normal(0, 1e-6, (3, 3)), skewed.translation)
    rotation = skewed.renormalised().rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-10)
    np.testing.assert_allclose(rotation, skewed.rotation, atol=1e-5)


def test_yaw_is_positive_to_the_right() -> None:
    turned_right = SE3.exp([0, 0, 0, 0, 0.3, 0])  # about y, which points down
    assert turned_right.yaw_rad == pytest.approx(0.3)
    assert (turned_right @ np.array([0.0, 0.0, 1.0]))[0] > 0


def test_propagated_covariance_agrees_with_sampling() -> None:
    rng = np.random.default_rng(2)
    a_from_b, b_from_c = SE3.exp([1, 2, 3, 0.3, -0.2, 0.5]), SE3.exp([-1, 0, 2, 0.1, 0.4, 0])
    first, second = np.diag([1, 2, 3, 1, 2, 1]) * 1e-6, np.diag([3, 1, 1, 2, 1, 3]) * 1e-6
    inverse = (a_from_b @ b_from_c).inverse()
    count = 4000
    samples = [
        (SE3.exp(a) @ a_from_b @ SE3.exp(b) @ b_from_c @ inverse).log()
        for a, b in zip(
            rng.multivariate_normal(np.zeros(6), first, count),
            rng.multivariate_normal(np.zeros(6), second, count),
            strict=True,
        )
    ]
    # 4,000 samples give a relative standard error of 2 % on a variance: six of them.
    np.testing.assert_allclose(
        np.diag(np.cov(np.array(samples).T)),
        np.diag(propagate_covariance(a_from_b, first, second)),
        rtol=0.13,
    )


@pytest.mark.parametrize(
    "matrix", [np.eye(3), np.full((4, 4), np.nan), np.diag([1, 1, -1, 1]), 2 * np.eye(4)]
)
def test_what_is_no_transform_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(InputError):
        SE3.from_matrix(matrix)
