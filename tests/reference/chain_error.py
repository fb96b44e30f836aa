"""The pivoted error of a covariance by NumPy's linear algebra: the oracle of the kernel."""

import numpy as np

from engram.geometry.se3 import SE3, skew
from engram.graph.basin import PivotedError, edge_error_rows


def error_of(covariance) -> PivotedError:
    """The kernel's model of a covariance, as edges get it."""
    tau, v, *pivot = edge_error_rows([(SE3.identity(), covariance)])[0, :5].tolist()
    return PivotedError(tau, v, np.array(pivot))


def pivoted_error(covariance):
    """τ, v, pivot: the pivot by minimising the trace of cov(t + r × p) as a least-squares fit."""
    rotation = covariance[3:, 3:]

    def trace_at(point):
        carried = np.hstack([np.eye(3), -skew(point)])
        return np.trace(carried @ covariance @ carried.T)

    # The trace is a quadratic form in p: read its coefficients off by evaluating it.
    axes = np.eye(3)
    gradient = np.array([(trace_at(a) - trace_at(-a)) / 2 for a in axes])
    hessian = np.array(
        [
            [trace_at(a + b) - trace_at(a) - trace_at(b) + trace_at(0 * a) for b in axes]
            for a in axes
        ]
    )
    pivot = -np.linalg.pinv(hessian, rcond=1e-6) @ gradient
    carried = np.hstack([np.eye(3), -skew(pivot)])
    translation = carried @ covariance @ carried.T
    return np.linalg.eigvalsh(translation)[-1], np.linalg.eigvalsh(rotation)[-1], pivot
