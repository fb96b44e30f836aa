"""Transforms of the core beside NumPy and SciPy, and their bits on every instruction set."""

import numpy as np
import pytest
from scipy.linalg import expm
from tests.instruction_sets import printed

from engram import _core
from engram.geometry.se3 import SE3, propagate_covariance, skew

_PRINTS = """
import numpy as np
from engram.geometry.se3 import SE3
rng = np.random.default_rng(5)
for scale in (1e-9, 1e-3, 1.0):
    a, b = (SE3.exp(tangent) for tangent in scale * rng.normal(size=(2, 6)))
    roots = rng.normal(size=(2, 6, 6))
    first, second = roots @ roots.transpose(0, 2, 1)
    both, covariance = a.chain(first, b, second)
    for array in (both.matrix(), covariance, both.log(), both.renormalised().rotation):
        print(array.tobytes().hex())
"""


def covariances(seed: int) -> np.ndarray:
    roots = np.random.default_rng(seed).normal(size=(2, 6, 6))
    return roots @ roots.transpose(0, 2, 1)


@pytest.mark.parametrize("scale", [1e-9, 1e-4, 1.0])
def test_exp_is_the_matrix_exponential(scale: float) -> None:
    tangent = scale * np.random.default_rng(1).normal(size=6)
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(tangent[3:]), tangent[:3]
    np.testing.assert_allclose(SE3.exp(tangent).matrix(), expm(generator), atol=1e-13)


@pytest.mark.parametrize("scale", [1e-9, 1e-4, 1.0])
def test_a_chain_is_the_product_with_its_covariance(scale: float) -> None:
    a, b = (SE3.exp(t) for t in scale * np.random.default_rng(2).normal(size=(2, 6)))
    first, second = covariances(3)
    both, covariance = a.chain(first, b, second)
    np.testing.assert_allclose(both.matrix(), (a @ b).matrix(), atol=1e-15)
    np.testing.assert_allclose(covariance, propagate_covariance(a, first, second), rtol=1e-13)


def test_a_transform_that_is_part_of_a_matrix_needs_no_copy() -> None:
    whole = SE3.exp([1, 2, 3, 0.1, 0.2, 0.3])
    matrix = whole.matrix()
    part = SE3(matrix[:3, :3], matrix[:3, 3])
    assert part.log().tobytes() == whole.log().tobytes()
    assert part.inverse().log() == pytest.approx(-whole.log(), abs=1e-14)


@pytest.mark.parametrize("variances", [(4, 1, 1), (4, 4, 1), (1, 1, 1), (0, 0, 0), (9, 1e-9, 0)])
def test_the_greatest_sigma_is_that_of_the_largest_eigenvalue(variances) -> None:
    turn = SE3.exp([0, 0, 0, 0.4, -1.0, 0.7]).rotation
    covariance = covariances(4)[0]
    covariance[:3, :3] = turn @ np.diag(variances) @ turn.T
    assert _core.greatest_sigma(covariance) == pytest.approx(max(variances) ** 0.5, abs=1e-12)


def test_bits_are_the_same_on_every_instruction_set() -> None:
    assert len(printed(_PRINTS)) == 1
