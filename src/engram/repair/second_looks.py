"""A second look at an edge: do other frames on both sides of it match as it says?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from engram.errors import MapCorruptError
from engram.frontend import feature_kind
from engram.frontend.matching import Match, match_frames, pair_seed
from engram.geometry import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, LandmarkSource
from engram.repair.config import RepairConfig
from engram.repair.surroundings import Near, Surroundings


@dataclass(frozen=True, slots=True)
class Look:
    """One pair of nodes that was matched to judge an edge.

    Attributes:
        a, b: dense indices of the nodes.
        way_m: path length from the edge's ends to the nodes, the longer of the two, metres.
        apart_m: how far they lie apart, if the edge is right.
        inliers: of the match, 0 without one.
        off_m, off_rad: how far the match lies from what the edge says; infinite without one.
    """

    a: int
    b: int
    way_m: float
    apart_m: float
    inliers: int
    off_m: float
    off_rad: float


class SecondLooks:
    """Matches the nodes around the ends of edges.

    Args:
        graph: the graph.
        frames: the landmarks of its nodes.
        surroundings: the ways that lead to the nodes around.
        config: which pairs are looked at.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        frames: LandmarkSource,
        surroundings: Surroundings,
        config: RepairConfig,
    ) -> None:
        self._graph = graph
        self._frames = frames
        self._surroundings = surroundings
        self._config = config

    def at(self, row: int) -> list[Look]:
        """The looks at an edge, the one at its own ends first.

        Args:
            row: its index in `graph.edges`.
        """
        edge = self._graph.edges[row]
        a, b = self._graph.index(edge.a), self._graph.index(edge.b)
        sides = [
            list(self._surroundings.around(end, self._config.look_within_m, without=row))
            for end in (a, b)
        ]
        return [self._look(one, other, pose) for one, other, pose in self._pairs(edge, *sides)]

    def _pairs(
        self, edge: Edge, side_a: Sequence[Near], side_b: Sequence[Near]
    ) -> list[tuple[Near, Near, SE3]]:
        """Pairs that should show the same things if the edge is right, spaced along the drives."""
        config = self._config
        found: list[tuple[float, Near, Near, SE3]] = []
        for one in side_a:
            near_a = one.root_from_node.inverse() @ edge.a_from_b
            for other in side_b:
                apart = near_a @ other.root_from_node
                if apart.distance_m <= config.look_apart_m and apart.angle_rad <= config.look_rad:
                    way_m = max(one.way_m, other.way_m)
                    found.append((way_m, one, other, apart))
        found.sort(key=lambda pair: (pair[0], pair[1].node, pair[2].node))
        chosen: list[tuple[Near, Near, SE3]] = []
        for _, one, other, apart in found:
            if all(
                _separate(one, kept[0], config.look_every_m)
                or _separate(other, kept[1], config.look_every_m)
                for kept in chosen
            ):
                chosen.append((one, other, apart))
            if len(chosen) == config.looks:
                break
        return chosen

    def _look(self, one: Near, other: Near, a_from_b: SE3) -> Look:
        ids = [self._graph.node(near.node).id for near in (one, other)]
        try:
            reference, live = (self._frames.frame(node) for node in ids)
            matcher = feature_kind(live.descriptor).matcher
            match = match_frames(reference, live, matcher, pair_seed(ids[1], ids[0]))
        except MapCorruptError:
            match = Match(None, None, 0, *(np.empty(0, np.int32),) * 2)
        way_m = max(one.way_m, other.way_m)
        off_m = off_rad = float("inf")
        if match.reference_from_live is not None:
            off = a_from_b.inverse() @ match.reference_from_live
            off_m, off_rad = off.distance_m, off.angle_rad
        return Look(one.node, other.node, way_m, a_from_b.distance_m, match.inliers, off_m, off_rad)


def _separate(one: Near, other: Near, every_m: float) -> bool:
    return (one.root_from_node.inverse() @ other.root_from_node).distance_m >= every_m
