"""Where a driving robot is in the map frame, also among nodes that it saved itself."""

from __future__ import annotations

import numpy as np

from engram.geometry import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import NodeId
from engram.graph.placing import MAP_FROM_CAMERA
from engram.localiser import Localisation
from engram.maps import MapFrame


class Whereabouts:
    """Follows a robot in the map frame, for display and messages.

    Nodes get their place in the frame with the revision that commits them. Until then one that the
    robot saved lies where the robot took itself to be; one that it saved while it was lost, where
    the graph has it, once that joins it to the map. In an empty map the first frame lies at the
    origin and looks along x, as the committed frame will have it.

    Args:
        frame: that of the map as it was when the drive began.
        graph: what the robot localises in, with the nodes that it saved.
    """

    def __init__(self, frame: MapFrame, graph: ExperienceGraph) -> None:
        self._frame, self._graph = frame, graph
        self._saved: dict[NodeId, SE3] = {}
        # A node with a place; and the one without for which the graph was asked, and its edges.
        self._placed: NodeId | None = None
        self._asked: tuple[NodeId, int] | None = None

    def of(self, node: NodeId) -> SE3 | None:
        """``map_from_node``; None for a node without a place."""
        return self._saved.get(node) or self._frame.find(node)

    def after(self, found: Localisation) -> SE3 | None:
        """``map_from_live`` at the next frame of the drive; None where it is not known.

        Args:
            found: the result of each frame, one after another.
        """
        position = found.position
        map_from_node = None if position is None else self._found(position.node)
        here = None
        if position is not None and map_from_node is not None:
            here = map_from_node @ position.node_from_live
        elif found.saved is not None and not self._saved and not len(self._frame.positions):
            here = SE3(MAP_FROM_CAMERA.copy(), np.zeros(3))
        if found.saved is not None and here is not None:
            self._saved[found.saved] = here
        return here

    def _found(self, node: NodeId) -> SE3 | None:
        """The place of a node, if need be along the graph from the last one that had a place."""
        map_from_node = self.of(node)
        if map_from_node is None:
            map_from_node = self._along_graph(node)
        if map_from_node is not None:
            self._placed = node
        return map_from_node

    def _along_graph(self, node: NodeId) -> SE3 | None:
        graph, placed = self._graph, self._placed
        asked = node, len(graph.edges)
        if placed is None or asked == self._asked or node not in graph or placed not in graph:
            return None
        self._asked = asked
        map_from_placed = self.of(placed)
        way = graph.predict(graph.index(placed), graph.index(node))
        if way is None or map_from_placed is None:
            return None
        self._saved[node] = map_from_placed @ way[0]
        return self._saved[node]
