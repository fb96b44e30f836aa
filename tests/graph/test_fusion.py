"""Fusing two estimates of one edge."""

from uuid import UUID

import numpy as np
import pytest

from engram.geometry.se3 import SE3
from engram.graph.model import Edge, EdgeKind, NodeId
from engram.graph.proximity import _fused

A, B = NodeId(UUID(int=1)), NodeId(UUID(int=2))


def edge(tangent: list[float], sigma_m: float, sigma_rad: float = 0.01) -> Edge:
    covariance = np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)
    return Edge(A, B, EdgeKind.PROXIMITY, SE3.exp(tangent), covariance)


def test_equal_certainty_meets_in_the_middle() -> None:
    one, other = edge([0, 0, 0, 0, 0, 0], 0.5), edge([0.4, 0, 0, 0, 0, 0], 0.5)
    fused = _fused(one, other.a_from_b, other.covariance)
    np.testing.assert_allclose(fused.a_from_b.translation, [0.2, 0, 0], atol=1e-12)
    np.testing.assert_allclose(fused.covariance, one.covariance / 2, atol=1e-12)


def test_the_surer_one_counts_more() -> None:
    vague, sure = edge([0, 0, 0, 0, 0, 0], 1.0), edge([0.5, 0, 0, 0, 0, 0], 0.1)
    fused = _fused(vague, sure.a_from_b, sure.covariance)
    assert fused.a_from_b.translation[0] == pytest.approx(0.5 / 1.01)


@pytest.mark.parametrize("sigma_m", [0.2, 5.0])
def test_of_two_that_contradict_each_other_the_surer_stands(sigma_m: float) -> None:
    here, there = edge([0, 0, 0, 0, 0, 0], 1.0), edge([60, 0, 5, 0, 1.2, 0], sigma_m)
    fused = _fused(here, there.a_from_b, there.covariance)
    expected = there if sigma_m < 1.0 else here
    np.testing.assert_array_equal(fused.a_from_b.matrix(), expected.a_from_b.matrix())
    np.testing.assert_array_equal(fused.covariance, expected.covariance)


def test_fusing_again_and_again_never_leaves_the_two_estimates() -> None:
    # A heading error far back swings the place: translation and rotation are tied together.
    lever = np.eye(6)
    lever[0, 4] = 80.0
    lean = lever @ np.diag([0.3, 0.3, 0.3, 0.02, 0.02, 0.02]) ** 2 @ lever.T
    one = Edge(A, B, EdgeKind.PROXIMITY, SE3.identity(), lean)
    rng = np.random.default_rng(5)
    for _ in range(200):
        there = SE3.exp(rng.normal(0, [3, 1, 3, 0.3, 0.5, 0.3]))
        one = _fused(one, there, np.diag([1.0, 1, 1, 0.05, 0.05, 0.05]) ** 2)
        assert one.a_from_b.distance_m < 20
        one = Edge(A, B, one.kind, one.a_from_b, lean)
