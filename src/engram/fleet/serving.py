"""Which nodes of a map serve least: judged patch by patch, so that a city is never read whole.

A node serves by the failures that it spares past drives, given the nodes that serve more: what a
download of kind `budget` without an hour takes first. Its gain depends on what lies around it,
and little on the rest of the map. So each patch of the map is judged with what surrounds it, and
the nodes of all patches are compared by their gains per byte.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from engram.fleet.download.coverage import basin_of, greedy_order, reach_of
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.part import Stock
from engram.fleet.download.selections import coverage_for
from engram.fleet.download.surroundings import Surroundings
from engram.maps.map import Map
from engram.maps.placed import SizedNodes

Rows = NDArray[np.int64]

# Bytes of a node besides its landmarks and picture, about: its rows, edges and attempts, indexed.
_NODE_BYTES = 2600
# Nodes of a patch, at most: some 200 MB of memory while it is judged.
PATCH_NODES = 8192
# Around a patch, in reaches of a match: what lies farther away hardly changes its order.
_AROUND = 2.0


def node_bytes(sizes: tuple[Rows, Rows]) -> Rows:
    """(N,) what each node takes in a map's file, about: landmarks, picture and rows.

    Args:
        sizes: (N,) bytes of landmarks, and (N,) of pictures.
    """
    landmarks, pictures = sizes
    return landmarks + pictures + _NODE_BYTES


def serving_order(stock: Stock) -> tuple[Rows, NDArray[np.float64]]:
    """All nodes, those that serve most first; of those that spare no failure, the newest first.

    Returns:
        (N,) int64, places in `Stock.nodes`; (N,) float64, the ratio of what each adds (the number
        of places with a match) to its bytes.
    """
    coverage = coverage_for(stock, DownloadOptions(select="budget"))
    size_bytes = node_bytes(stock.sizes).astype(np.float64)
    return greedy_order(coverage, size_bytes, np.arange(len(stock))[::-1])


def going_order(store: Map, nodes: SizedNodes, most: int = PATCH_NODES) -> Rows:
    """(N,) rows of all nodes, those that serve least first; of those that serve nothing the oldest.

    Args:
        store: the map.
        nodes: all its nodes.
        most: nodes of a patch.
    """
    gain = np.zeros(len(nodes))
    # Of nodes with one gain: those without any go by age, others in reverse order.
    turn = np.empty(len(nodes), np.int64)
    turn[_by_age(nodes)] = np.arange(len(nodes))
    around_m = _AROUND * reach_of(basin_of(store.cameras.values()))
    for own in patches(nodes.positions[:, :2], most):
        here = None
        if len(own) < len(nodes):
            here = Surroundings.of(store.pages, None, nodes.keys[own] - 1, around_m)
        order, gains = serving_order(stock := Stock(store, here=here))
        gains = np.minimum.accumulate(gains)  # but for rounding they fall
        rows = np.searchsorted(nodes.keys, stock.indices[order] + 1)
        taken = np.flatnonzero(np.isin(rows, own) & (gains > 0))
        gain[rows[taken]], turn[rows[taken]] = gains[taken], -taken
    return np.lexsort((turn, gain))


def _by_age(nodes: SizedNodes) -> Rows:
    """(N,) rows by the start of their drive, then by stamp; where these are equal by UUIDs."""
    starts = np.array([one.start_ns for one in nodes.sessions], np.int64)
    ranked = sorted(range(len(starts)), key=lambda at: (starts[at], nodes.sessions[at].id))
    rank = np.empty(len(starts), np.int64)
    rank[ranked] = np.arange(len(starts))
    words = np.ascontiguousarray(nodes.uuids).view(">u8").reshape(-1, 2)
    return np.lexsort((words[:, 1], words[:, 0], nodes.stamp_ns, rank[nodes.session]))


def patches(positions: NDArray[np.float64], most: int) -> Iterator[Rows]:
    """Rows of positions that lie near each other, at most so many, in halves of halves.

    Args:
        positions: (N, 2) float64, x and y in the map frame, metres; NaN without a place.
        most: positions at once.
    """
    known = np.nan_to_num(positions)
    waiting = [np.arange(len(positions))]
    while waiting:
        own = waiting.pop()
        if len(own) <= most:
            yield np.sort(own)
            continue
        axis = int(np.argmax(np.ptp(known[own], axis=0)))
        ordered = own[np.argsort(known[own, axis], kind="stable")]
        waiting += [ordered[len(own) // 2 :], ordered[: len(own) // 2]]
