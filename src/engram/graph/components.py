"""Which nodes hang together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]


def labels_of(ends: Indices, count: int) -> Indices:
    """(N,) int64: the component of each node by (E, 2) ends, numbered by first node."""
    from scipy.cluster.hierarchy import DisjointSet

    parts = DisjointSet(range(count))
    for a, b in ends.tolist():
        parts.merge(a, b)
    number: dict[int, int] = {}
    return np.array(
        [number.setdefault(parts[node], len(number)) for node in range(count)], np.int64
    )


def grouped(labels: NDArray[np.integer]) -> list[Indices]:
    """The indices of each of (N,) labels, increasing; labels in the order of their first index."""
    if not len(labels):
        return []
    order = np.argsort(labels, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
    return sorted(groups, key=lambda group: int(group[0]))
