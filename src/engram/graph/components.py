"""Connected components of the graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]


def labels_of(ends: NDArray[np.integer], count: int) -> Indices:
    """(N,) int64: the component of each node by (E, 2) ends, numbered by first node."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    links = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    labels = connected_components(links, directed=False)[1]
    return np.asarray(labels, dtype=np.int64)


def grouped(labels: NDArray[np.integer]) -> list[Indices]:
    """The indices of each of (N,) labels, increasing; labels in the order of their first index."""
    if not len(labels):
        return []
    order = np.argsort(labels, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
    return sorted(groups, key=lambda group: int(group[0]))
