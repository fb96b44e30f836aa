"""A localised drive as one trajectory in TUM format, for other programs.

The map has no global frame. The trajectory's frame is the camera of the first localised node; the
least uncertain chain of edges places the other nodes, and odometry the frames without a match. The
trajectory is therefore not globally consistent, as its header states.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from engram.geometry.se3 import SE3
from engram.graph.graph import ChainTree, ExperienceGraph
from engram.graph.model import NodeId
from engram.localiser.localisation import Localisation
from engram.sequences.motion_files import Trajectory, write_tum

HEADER = (
    "timestamp x y z qx qy qz qw; seconds, metres; frame: camera of the first localised node",
    "chained along the least uncertain edges, gaps by odometry: not globally consistent",
)


def chain_trajectory(
    graph: ExperienceGraph, results: Sequence[Localisation]
) -> list[tuple[int, SE3]]:
    """Poses of the live camera in the frame of the first localised node.

    Frames before the first localised one are left out, and so are frames from a loss of odometry
    to the next match. Fixes that the robot withdrew count as frames without a match.

    Returns:
        (stamp_ns, first_from_live) of each placed frame, in temporal order.
    """
    placed = _PlacedNodes(graph)
    withdrawn = {stamp_ns for result in results for stamp_ns in result.withdraws}
    trajectory: list[tuple[int, SE3]] = []
    first_from_live: SE3 | None = None
    for result in results:
        stands = result.stamp_ns not in withdrawn
        if stands and result.node is not None and result.node_from_live is not None:
            first_from_node = placed.place(result.node, first_from_live, result.node_from_live)
            first_from_live = (
                None if first_from_node is None else first_from_node @ result.node_from_live
            )
        elif first_from_live is not None:
            moved = result.motion.odometry.prev_from_curr
            first_from_live = None if moved is None else first_from_live @ moved
        if first_from_live is not None:
            trajectory.append((result.stamp_ns, first_from_live))
    return trajectory


class _PlacedNodes:
    def __init__(self, graph: ExperienceGraph) -> None:
        self._graph = graph
        self._tree: ChainTree | None = None
        self._first_from: dict[NodeId, SE3] = {}

    def place(self, node: NodeId, first_from_live: SE3 | None, node_from_live: SE3) -> SE3 | None:
        """Pose of a node: by the graph, else by the live camera's pose from odometry."""
        if node not in self._first_from:
            placed = self._by_the_graph(self._graph.index(node))
            if placed is None and first_from_live is not None:
                placed = first_from_live @ node_from_live.inverse()
            if placed is None:
                return None
            self._first_from[node] = placed
        return self._first_from[node]

    def _by_the_graph(self, index: int) -> SE3 | None:
        if self._tree is None:
            self._tree = self._graph.chains_from(index)
        return self._tree.pose(index) if index in self._tree.row_of else None


def write_trajectory(path: Path, graph: ExperienceGraph, results: Sequence[Localisation]) -> None:
    """Writes a localised drive in TUM format."""
    placed = chain_trajectory(graph, results)
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in placed], dtype=np.int64)
    write_tum(path, Trajectory(stamps_ns, [pose for _, pose in placed]), HEADER)
