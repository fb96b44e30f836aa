"""What an edge must be before it is written."""

from __future__ import annotations

import numpy as np

from engram.errors import InputError
from engram.graph.model import Edge

# Covariances come from products with their own transposes: what is left of asymmetry is rounding.
_ASYMMETRY_LIMIT = 1e-6


def check_edge(edge: Edge) -> None:
    """Refuse an edge that no map should hold.

    Raises:
        InputError: it joins a node with itself, or its numbers are not finite and symmetric.
    """
    what = f"edge {edge.a} → {edge.b} ({edge.kind})"
    if edge.a == edge.b:
        raise InputError(f"{what} joins a node with itself")
    transform = np.concatenate([edge.a_from_b.rotation.ravel(), edge.a_from_b.translation])
    if not np.isfinite(transform).all() or edge.covariance.shape != (6, 6):
        raise InputError(f"{what}: a transform is finite, its covariance (6, 6)")
    asymmetry = np.abs(edge.covariance - edge.covariance.T).max()
    if not asymmetry <= _ASYMMETRY_LIMIT * max(1.0, np.abs(edge.covariance).max()):
        raise InputError(f"{what}: its covariance is not finite and symmetric")
