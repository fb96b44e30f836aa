"""Annotations of a map in addition to recordings: removals, places, anchors and goals."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias

from engram.geometry import SE3
from engram.graph.model import Edge, EdgeKind, NodeId

# Two measurements of one edge within this are the same measurement: a look-alike that is matched
# again gives its pose again to some centimetres, a true match of the same nodes lies elsewhere.
SAME_M, SAME_RAD = 1.0, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Removal:
    """An edge that no longer counts, though its record stays.

    Attributes:
        a, b, kind: its key; the order of the ends does not matter.
        a_from_b: what it measured. Another measurement between the same nodes counts.
        reason: the evidence, for people.
        removed_ns: time of the removal, UTC; distinguishes equal ones.
    """

    a: NodeId
    b: NodeId
    kind: EdgeKind
    a_from_b: SE3
    reason: str
    removed_ns: int

    @property
    def key(self) -> tuple[NodeId, NodeId, EdgeKind, int]:
        """Distinguishes removals, the order of ends included."""
        return self.a, self.b, self.kind, self.removed_ns


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where a node lies in the map frame.

    Attributes:
        node: the node.
        map_from_node: pose of its camera in the map frame: x, y horizontal, z up, metres.
    """

    node: NodeId
    map_from_node: SE3


@dataclass(frozen=True, slots=True)
class Anchor:
    """A known position of a node in the map frame.

    Attributes:
        node: the node.
        x_m, y_m: its camera's position in the map frame, metres.
        z_m: its height, metres; None if unknown.
        sigma_m: standard deviation along each axis, metres.
        source: where it comes from, for people.
    """

    node: NodeId
    x_m: float
    y_m: float
    z_m: float | None
    sigma_m: float
    source: str


@dataclass(frozen=True, slots=True, eq=False)
class Goal:
    """A named pose, stored relative to a node: it stays where it is when the frame moves.

    Attributes:
        name: its name; of goals of one name the newest counts.
        node: the node that it is stored in.
        node_from_goal: pose of a robot's camera that stands at the goal, in the node's camera.
    """

    name: str
    node: NodeId
    node_from_goal: SE3


Mark: TypeAlias = Removal | Placement | Anchor | Goal


class Removed:
    """Which edges were removed.

    Args:
        removals: in any order.
    """

    def __init__(self, removals: Iterable[Removal]) -> None:
        self._known: dict[tuple[frozenset[NodeId], EdgeKind], list[Removal]] = defaultdict(list)
        for one in removals:
            self._known[frozenset((one.a, one.b)), one.kind].append(one)

    def __bool__(self) -> bool:
        return bool(self._known)

    def __contains__(self, edge: Edge) -> bool:
        """Whether the edge is a removed one, or its measurement made again."""
        return any(
            same_measurement(
                one.a_from_b, edge.a_from_b if edge.a == one.a else edge.a_from_b.inverse()
            )
            for one in self._known.get((frozenset((edge.a, edge.b)), edge.kind), ())
        )


def same_measurement(removed: SE3, measured: SE3) -> bool:
    """Whether two transforms between the same nodes are one measurement."""
    apart = removed.inverse() @ measured
    return apart.distance_m <= SAME_M and apart.angle_rad <= SAME_RAD
