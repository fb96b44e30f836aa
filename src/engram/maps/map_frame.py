"""The map frame: where nodes and goals lie, for messages, display and exports."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from engram.counts import counted
from engram.errors import InputError
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, Goal, Node, NodeId, Placement
from engram.graph.placing import DEFAULT_CONFIG as PLACING
from engram.graph.placing import PlacingConfig, Poses, place, replace_after_removal

if TYPE_CHECKING:
    from engram.maps.lookups import Lookups
    from engram.maps.map import Map


# Metres per degree of latitude, and the least movement that is worth a word.
_DEGREE_M = 111_320.0
_WORTH_M = 0.05
# No coordinate in the map frame is larger, whatever grid it is of.
FARTHEST_M = 1e9
# Directions in which a goal and the node that it is stored in may differ, before distance counts.
_ALIKE_RAD = np.pi / 2
_TURNED_AWAY_M = 5.0
_KEPT = 1024
# How far from a goal its node is looked for, one after another, metres.
_WITHIN_M = (*(2.0**power for power in range(5, 13)), np.inf)


@dataclass(frozen=True, slots=True)
class FramePose:
    """A pose in the map frame, from above.

    Attributes:
        x_m, y_m, z_m: position, metres.
        yaw_rad: direction of view, from x towards y.
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float

    @staticmethod
    def of(map_from_camera: SE3) -> FramePose:
        """The pose of a camera, of which z looks forward."""
        ahead = map_from_camera.rotation[:, 2]
        x_m, y_m, z_m = map_from_camera.translation.tolist()
        return FramePose(x_m, y_m, z_m, float(np.arctan2(ahead[1], ahead[0])))

    def to_dict(self) -> dict[str, float]:
        """Plain values; the direction in degrees."""
        return {
            # Adding 0.0 makes -0.0 positive.
            "x_m": round(self.x_m, 4) + 0.0,
            "y_m": round(self.y_m, 4) + 0.0,
            "z_m": round(self.z_m, 4) + 0.0,
            "yaw_deg": round(float(np.rad2deg(self.yaw_rad)), 3) + 0.0,
        }


class MapFrame:
    """Where the nodes of a map lie: x, y horizontal and z up, metres; read for some at a time.

    Nodes keep their place from one revision to the next, unless the map is anchored again or a
    repair shows that they were in a wrong place. Components whose relative pose is unknown stand
    side by side. Nothing localises by it.

    Args:
        lookups: questions to the map.
        origin: latitude and longitude of the frame's origin, degrees; None if unknown.

    Attributes:
        origin: as given.
    """

    def __init__(self, lookups: Lookups, origin: tuple[float, float] | None = None) -> None:
        self._lookups = lookups
        self.origin = origin
        # A robot asks for the node where it is at each frame.
        self._kept = lru_cache(maxsize=_KEPT)(self._read)

    @property
    def is_empty(self) -> bool:
        """Whether no node has a place."""
        return self._lookups.is_empty()

    def pose(self, node: NodeId) -> SE3:
        """``map_from_node``, the pose of a node's camera.

        Raises:
            InputError: the map has no such node.
        """
        found = self.find(node)
        if found is None:
            raise InputError(f"node {node} has no place in the map frame")
        return found

    def find(self, node: NodeId) -> SE3 | None:
        """``map_from_node``; None for a node that has no place in the frame (yet)."""
        return self._kept(node)

    def _read(self, node: NodeId) -> SE3 | None:
        return self._lookups.places([node]).get(node)

    def goal(self, x_m: float, y_m: float, yaw_rad: float, name: str = "") -> Goal:
        """A pose in the map frame as a goal, which stays valid when the frame moves.

        It is stored relative to the nearest node, rather to one that looks in the same direction.
        Height and slope are the node's.

        Args:
            x_m, y_m: its position, metres.
            yaw_rad: its direction, from x towards y.
            name: its name.

        Raises:
            InputError: the map has no nodes, or a number is not finite or above `FARTHEST_M`.
        """
        if not (np.abs((x_m, y_m, yaw_rad)) <= FARTHEST_M).all():
            raise InputError(
                f"goal {name!r}: x {x_m:g}, y {y_m:g}, yaw {yaw_rad:g} must be finite, at most "
                f"{FARTHEST_M:g}"
            )
        for within_m in _WITHIN_M:
            found = self._lookups.places_near(x_m, y_m, within_m)
            if not found:
                continue
            poses = list(found.values())
            ahead = np.array([pose.rotation[:2, 2] for pose in poses])
            yaws_rad = np.arctan2(ahead[:, 1], ahead[:, 0])
            away_m = np.array([pose.translation[:2] for pose in poses]) - (x_m, y_m)
            turned = np.abs(np.angle(np.exp(1j * (yaws_rad - yaw_rad))))
            distance_m = np.hypot(*away_m.T) + _TURNED_AWAY_M * (turned > _ALIKE_RAD)
            at = int(np.argmin(distance_m))
            if distance_m[at] <= within_m:  # beyond there may be a nearer one
                break
        else:
            raise InputError("the map has no nodes: there is nothing to store a goal in")
        turn = _about_vertical(yaw_rad - float(yaws_rad[at]))
        height_m = float(poses[at].translation[2])
        map_from_goal = SE3(turn @ poses[at].rotation, np.array([x_m, y_m, height_m]))
        return Goal(name, list(found)[at], poses[at].inverse() @ map_from_goal)

    def locate(self, goal: Goal) -> FramePose:
        """Where a goal lies now.

        Raises:
            InputError: the map does not have its node.
        """
        return FramePose.of(self.pose(goal.node) @ goal.node_from_goal)

    def geographic(self, x_m: float, y_m: float) -> tuple[float, float] | None:
        """Latitude and longitude of a position, degrees; None without anchors on earth."""
        if self.origin is None:
            return None
        latitude = self.origin[0] + y_m / _DEGREE_M
        return latitude, self.origin[1] + x_m / (
            _DEGREE_M * float(np.cos(np.deg2rad(self.origin[0])))
        )

    def near(self, latitude_deg: float, longitude_deg: float, within_m: float) -> list[NodeId]:
        """Nodes near a place on earth, nearest first; none without anchors."""
        if self.origin is None:
            return []
        here = local_m(np.array([latitude_deg]), np.array([longitude_deg]), self.origin)[0]
        found = self._lookups.places_near(float(here[0]), float(here[1]), within_m)
        away_m = {
            node: float(np.linalg.norm(pose.translation[:2] - here)) for node, pose in found.items()
        }
        near = [node for node, far_m in away_m.items() if far_m <= within_m]
        return sorted(near, key=away_m.__getitem__)


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The places of all nodes of a map in its frame.

    Attributes:
        graph: the graph of the map.
        poses: ``map_from_node`` by dense index.
    """

    graph: ExperienceGraph
    poses: Poses

    @property
    def positions(self) -> NDArray[np.float64]:
        """(N, 3) float64, metres: the camera of each node, by dense index. Read-only."""
        return self.poses.translations

    def pose(self, node: NodeId) -> SE3:
        """``map_from_node``, the pose of a node's camera.

        Raises:
            InputError: the map has no such node.
        """
        return self.poses.pose(self.graph.index(node))

    def placements(self) -> list[Placement]:
        """Where every node lies."""
        return [Placement(node.id, self.poses.pose(at)) for at, node in enumerate(self.graph.nodes)]


def local_m(
    latitude_deg: NDArray[np.float64],
    longitude_deg: NDArray[np.float64],
    origin: tuple[float, float],
) -> NDArray[np.float64]:
    """(P, 2) float64, metres east and north of an origin; undoes `MapFrame.geographic`."""
    per_degree = _DEGREE_M * float(np.cos(np.deg2rad(origin[0])))
    return np.stack(
        [(longitude_deg - origin[1]) * per_degree, (latitude_deg - origin[0]) * _DEGREE_M], axis=1
    )


@dataclass(frozen=True, slots=True)
class Moves:
    """What moved in the map frame.

    Attributes:
        nodes: number of nodes that moved by 5 cm or more, of those placed before.
        of_nodes: number of nodes placed before.
        median_m, largest_m: how far they moved.
        goals: how far each goal moved, metres, of those that did.
        lost_goals: goals whose node is gone.
    """

    nodes: int
    of_nodes: int
    median_m: float
    largest_m: float
    goals: Mapping[str, float]
    lost_goals: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.nodes or self.goals or self.lost_goals)

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "nodes": self.nodes,
            "of_nodes": self.of_nodes,
            "median_m": round(self.median_m, 3),
            "largest_m": round(self.largest_m, 3),
            "goals": {name: round(far_m, 3) for name, far_m in self.goals.items()},
            "lost_goals": list(self.lost_goals),
        }

    def text(self) -> str:
        """In words; "" if nothing moved."""
        said = []
        if self.nodes:
            said.append(
                f"{self.nodes} of {counted(self.of_nodes, 'node')} moved in the map frame: median "
                f"{self.median_m:.2f} m, largest {self.largest_m:.2f} m"
            )
        said += [f"goal {name} moved by {far_m:.2f} m" for name, far_m in self.goals.items()]
        said += [f"goal {name} lost its node" for name in self.lost_goals]
        return "\n".join(said)


def moves(
    before: Mapping[NodeId, SE3], after: Mapping[NodeId, SE3], goals: Iterable[Goal] = ()
) -> Moves:
    """What moved between two layouts.

    Args:
        before, after: ``map_from_node`` of the placed nodes.
        goals: goals known before.
    """
    both = [node for node in before if node in after]
    others = [node for node in both if before[node] is not after[node]]
    apart_m = np.array([_apart_m(before[node], after[node]) for node in others])
    moved = apart_m[apart_m >= _WORTH_M]
    far_m, lost = {}, []
    for goal in goals:
        if goal.node not in before:
            continue
        if goal.node not in after:
            lost.append(goal.name)
            continue
        at, to = (known[goal.node] @ goal.node_from_goal for known in (before, after))
        if _apart_m(at, to) >= _WORTH_M:
            far_m[goal.name] = _apart_m(at, to)
    median_m, largest_m = (
        (float(np.median(moved)), float(moved.max())) if len(moved) else (0.0,) * 2
    )
    return Moves(len(moved), len(both), median_m, largest_m, far_m, tuple(lost))


def changed(
    before: Mapping[NodeId, SE3],
    graph: ExperienceGraph,
    poses: Poses,
    same_m: float = PLACING.same_m,
) -> list[Placement]:
    """The placements that a revision has to write: of new nodes, and of those that moved.

    Args:
        before: ``map_from_node`` of the nodes that have a place.
        graph: the graph.
        poses: the layout.
        same_m: see `PlacingConfig`.
    """
    known = [before.get(node.id) for node in graph.nodes]
    stays = np.array([pose is not None for pose in known], np.bool_)
    placed = [pose for pose in known if pose is not None]
    if placed:
        turns = np.array([pose.rotation for pose in placed]) - poses.rotations[stays]
        shifts = np.array([pose.translation for pose in placed]) - poses.translations[stays]
        stays[stays] = ~_moved(turns, shifts, same_m)
    return [Placement(graph.nodes[at].id, poses.pose(at)) for at in np.flatnonzero(~stays).tolist()]


def _moved(
    turns: NDArray[np.float64], shifts: NDArray[np.float64], same: float
) -> NDArray[np.bool_]:
    """(N,): whether the differences (N, 3, 3) of rotations and (N, 3) of positions are large."""
    chords = np.linalg.norm(turns.reshape(-1, 9), axis=1) / np.sqrt(8)
    angles_rad = 2 * np.arcsin(np.minimum(chords, 1.0))
    return np.asarray((np.linalg.norm(shifts, axis=1) > same) | (angles_rad > same))


def _apart_m(one: SE3, other: SE3) -> float:
    return float(np.linalg.norm(one.translation - other.translation))


def _about_vertical(yaw_rad: float) -> NDArray[np.float64]:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


# Name of the statistic that holds latitude and longitude of the frame's origin.
ORIGIN = "map_frame"


def frame_of(store: Map, revision: int) -> MapFrame:
    """The map frame of an opened map; `Map.frame` shares it.

    Args:
        store: the map.
        revision: of the map, for `Map.derived`: the frame changes with it.
    """
    del revision
    origin = store.statistics().get(ORIGIN)
    known = None if not origin else (origin["latitude_deg"], origin["longitude_deg"])
    return MapFrame(store.lookups, known)


def layout_of(store: Map) -> Layout:
    """The layout of an opened map, for `Map.derived`."""
    return Layout(store.graph, place(store.graph, store.placements))


def all_places(store: Map, contents: Mapping[str, float], config: PlacingConfig) -> list[Placement]:
    """The places that an open revision has to write, by a layout of the whole map.

    Args:
        store: the map, which sees the rows of the revision.
        contents: number of rows that the revision wrote, by table.
        config: how new nodes are laid out.
    """
    found = store.load()
    graph = graph_of(found.nodes, found.edges)
    own = contents["placements"] or contents["hidden"]
    before = store.read_placements() if own else store.placements
    lay_out = replace_after_removal if contents["removals"] else place
    return changed(before, graph, lay_out(graph, before, config), config.same_m)


def graph_of(nodes: Sequence[Node], edges: Sequence[Edge]) -> ExperienceGraph:
    """A graph of these records."""
    graph = ExperienceGraph()
    graph.add_nodes(nodes)
    graph.add_edges(edges)
    return graph
