"""Where a drive starts in a map: by truth, or found by matching (method §8)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from engram.frontend import FrameStatus
from engram.geometry import SE3
from engram.graph.basin import DEFAULT_RADIUS_M
from engram.graph.graph import ExperienceGraph
from engram.graph.model import NodeId, SessionId, node_id
from engram.localiser import AcceptanceConfig, Matcher, Position, accept_lost
from engram.maps import Map
from engram.sequences import LoggedFrame
from engram_lab.studies.drives import Truth

# What an operator who sets a robot down knows of its place.
_SIGMA_M = 0.25
_SIGMA_RAD = float(np.deg2rad(1.0))
_VIEW_GATE_RAD = float(np.deg2rad(60.0))  # as for candidates, method §3.1


class TrueNodes:
    """True poses of a map's nodes.

    Args:
        opened: the map.
        truths: of the sessions that it was built from; may lack some.
    """

    def __init__(self, opened: Map, truths: Mapping[SessionId, Truth | None]) -> None:
        self._poses: dict[NodeId, SE3] = {}
        for node in opened.graph.nodes:
            truth = truths.get(node.session)
            pose = None if truth is None else truth.at(node.stamp_ns)
            if pose is not None:
                self._poses[node.id] = pose
        self._ids = list(self._poses)
        self._in_main = _in_largest_component(opened.graph, self._ids)
        poses = list(self._poses.values())
        self._positions = np.array([pose.translation for pose in poses]).reshape(-1, 3)
        self._headings = np.array([pose.rotation[:, 2] for pose in poses]).reshape(-1, 3)

    def pose(self, node: NodeId) -> SE3 | None:
        """``world_from_node``; None where it is not known."""
        return self._poses.get(node)

    def near(self, world_from_live: SE3, radius_m: float) -> set[NodeId]:
        """The nodes that are truly within a radius and look in the same direction (method §3.1)."""
        apart_m = np.linalg.norm(self._positions - world_from_live.translation, axis=1)
        alike = self._headings @ world_from_live.rotation[:, 2] >= np.cos(_VIEW_GATE_RAD)
        return {self._ids[k] for k in np.flatnonzero((apart_m <= radius_m) & alike)}

    def start(self, world_from_live: SE3) -> Position | None:
        """The position seen from the nearest node with the same heading; None without nodes.

        Rather of those that hang together: what a drive saved where its odometry had lost track,
        in heavy rain, may be joined to nothing, and a robot set down there would find no other
        node all day.
        """
        if not self._ids:
            return None
        distance_m = np.linalg.norm(self._positions - world_from_live.translation, axis=1)
        away = self._headings @ world_from_live.rotation[:, 2] < np.cos(_VIEW_GATE_RAD)
        apart = ~self._in_main | (distance_m > DEFAULT_RADIUS_M)
        # Nodes that look another way only where there are no others.
        node = self._ids[int(np.lexsort((distance_m, apart, away))[0])]
        covariance = np.diag([_SIGMA_M**2] * 3 + [_SIGMA_RAD**2] * 3)
        return Position(node, self._poses[node].inverse() @ world_from_live, covariance)


def _in_largest_component(graph: ExperienceGraph, nodes: Sequence[NodeId]) -> NDArray[np.bool_]:
    """(N,) whether each node is in the graph's largest connected component."""
    labels = graph.components()
    largest = np.argmax(np.bincount(labels)) if len(labels) else -1
    rows = np.array([graph.index(node) for node in nodes], np.int64)
    return np.asarray(labels[rows] == largest)


def start_by_matching(
    opened: Map,
    frames: Sequence[LoggedFrame],
    live: SessionId,
    matcher: Matcher,
    acceptance: AcceptanceConfig,
) -> tuple[int, Position] | None:
    """The first frame that matches a node of the map, and its position there.

    Every node is matched, so that where a drive starts does not depend on any policy. It is held
    to what a lost robot must show. Where the first 200 frames match nothing, nothing will.

    Returns:
        Number of the frame and the position; None where there is none.
    """
    for number, logged in enumerate(frames[:200]):
        frame = logged.frame
        if frame.status is not FrameStatus.OK:
            continue
        live_id = node_id(live, frame.stamp_ns)
        found = []
        for node in opened.graph.nodes:
            match = matcher.match(frame, live_id, node.id, None)
            spread = partial(matcher.spread, frame, live_id, node.id, match)
            if accept_lost(match, spread, acceptance):
                found.append((match, node.id))
        if found:
            match, best = max(found, key=lambda one: (one[0].inliers, one[1].int))
            assert match.reference_from_live is not None
            assert match.covariance is not None
            return number, Position(best, match.reference_from_live, match.covariance)
    return None
