"""Which edges the rest of a map contradicts, and which nothing else confirms."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.graph.adjusting import Adjusted, Measured, Poses, adjust
from engram.graph.graph import ExperienceGraph
from engram.graph.model import EdgeKind
from engram.graph.placing import chain_poses
from engram.repair.config import RepairConfig
from engram.repair.surroundings import Surroundings, is_measured


@dataclass(frozen=True, slots=True, eq=False)
class Suspicion:
    """How the edges of a graph agree with each other, by index in `graph.edges`.

    Attributes:
        off_m, off_rad: (E,) float64, disagreement with the adjusted map.
        chi2: (E,) float64, the same squared, in units of its variance.
        measured: (E,) bool, edges that are measurements.
        contradicted: (E,) bool, measurements that the rest of the map contradicts.
        confirmed: (E,) bool, measurements that a short other path between their ends confirms.
        poses: the adjusted map.
    """

    off_m: NDArray[np.float64]
    off_rad: NDArray[np.float64]
    chi2: NDArray[np.float64]
    measured: NDArray[np.bool_]
    contradicted: NDArray[np.bool_]
    confirmed: NDArray[np.bool_]
    poses: Poses


def suspect(graph: ExperienceGraph, config: RepairConfig, gone: Collection[int] = ()) -> Suspicion:
    """Adjusts the whole map robustly, and reports the edges it contradicts or does not confirm.

    Args:
        graph: the graph.
        config: settings.
        gone: indices of edges that are left out.
    """
    edges = graph.edges
    ends = graph.edge_ends.astype(np.int64)[:, ::-1]
    measured = np.array([is_measured(edge.kind) for edge in edges], np.bool_)
    measured[list(gone)] = False
    used = measured | np.array([edge.kind is EdgeKind.BRIDGE for edge in edges], np.bool_)
    rows = np.flatnonzero(used)
    adjusted = _adjusted(graph, rows, ends, config)
    every = Measured.of(edges, ends, config.adjust)
    error = every.residuals(adjusted.poses)
    off_m, off_rad = (np.linalg.norm(part, axis=1) for part in (error[:, :3], error[:, 3:]))
    chi2 = every.chi2(adjusted.poses)
    gross = (off_m > config.gross_m) | (off_rad > config.gross_rad)
    contradicted = measured & gross & (chi2 > config.gross_chi2)
    confirmed = np.zeros(len(edges), np.bool_)
    trusted = Surroundings(graph, used & ~contradicted)
    for row in np.flatnonzero(measured & ~contradicted).tolist():
        a, b = ends[row].tolist()
        confirmed[row] = trusted.connects(a, b, config.cycle_m, without=row)
    return Suspicion(off_m, off_rad, chi2, measured, contradicted, confirmed, adjusted.poses)


def _adjusted(
    graph: ExperienceGraph,
    rows: NDArray[np.intp],
    ends: NDArray[np.int64],
    config: RepairConfig,
) -> Adjusted:
    edges = [graph.edges[row] for row in rows.tolist()]
    poses, roots = chain_poses(edges, ends[rows], len(graph))
    free = np.ones(len(graph), np.bool_)
    free[roots] = False
    measured = Measured.of(edges, ends[rows], config.adjust)
    return adjust(poses, measured, free, config.adjust)


def part_labels(ends: NDArray[np.integer], count: int) -> NDArray[np.int32]:
    """(N,) int32: the component of each node, joined by edges with these ends (E, 2)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = ends.T
    links = coo_matrix((np.ones(len(ends)), (a, b)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], np.int32)
