"""Which of the nodes that a merge takes hang together with what the centre had."""

from __future__ import annotations

from scipy.cluster.hierarchy import DisjointSet

from engram.graph.model import Edge, NodeId

# Stands for all nodes that the centre had before, in whatever parts they lie.
_CENTRE = None


class Parts:
    """Grows with the nodes taken and their edges; asking costs next to nothing."""

    def __init__(self) -> None:
        self._parts: DisjointSet = DisjointSet([_CENTRE])

    def take(self, node: NodeId) -> None:
        """A node that the centre was lacking."""
        self._parts.add(node)

    def join(self, edge: Edge) -> None:
        """An edge between two nodes of the centre, old or new."""
        a, b = (end if end in self._parts else _CENTRE for end in (edge.a, edge.b))
        self._parts.merge(a, b)

    def is_apart(self, node: NodeId) -> bool:
        """Whether a node was taken in this merge, and nothing leads from it to what was there."""
        return node in self._parts and not self._parts.connected(node, _CENTRE)
