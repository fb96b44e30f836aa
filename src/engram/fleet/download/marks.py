"""What a download carries in addition to records: removed edges, placed nodes, goals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from engram.fleet.download.part import Part
from engram.geometry import SE3
from engram.graph.marks import Goal, Mark, Placement
from engram.graph.model import NodeId
from engram.maps import Map, RevisionWriter
from engram.maps.laying_out import ORIGIN
from engram.robot.goals import had_goal

# The robot's map speaks of the fleet's frame if the nodes of both lie as near as this, metres.
_SAME_FRAME_M = 0.01


def write_marks(writer: RevisionWriter, part: Part) -> None:
    """Writes the marks of a part into an empty map, after its nodes.

    Nodes keep their place in the map frame, so a robot and its fleet speak of the same frame. A
    goal whose node is not sent moves to the nearest one that is.
    """
    store = part.stock.store
    sent = set(part.node_ids)
    for removal in store.removals:
        if {removal.a, removal.b} <= sent:
            writer.add_mark(removal)
    for node in part.node_ids:
        if node in store.placements:
            writer.add_mark(Placement(node, store.placements[node]))
    for anchor in store.anchors:
        if anchor.node in sent:
            writer.add_mark(anchor)
    origin = store.statistics().get(ORIGIN)
    if origin is not None:
        writer.put_statistic(ORIGIN, origin)
    for goal in _goals(part):
        writer.add_mark(goal)


def lacking_marks(part: Part, own: Map) -> list[Mark]:
    """The marks of a part that are new to a robot's map; of places those of nodes new to it."""
    store, sent = part.stock.store, set(part.node_ids)
    lacking: list[Mark] = [
        removal
        for removal in store.removals
        if {removal.a, removal.b} <= sent and removal.key not in own.seen_removals
    ]
    lacking += [
        goal for goal in _goals(part) if goal.name not in own.goals and not had_goal(own, goal)
    ]
    if _one_frame(own.placements, store.placements):
        lacking += [
            Placement(node, store.placements[node])
            for node in part.node_ids
            if node in store.placements and node not in own.placements
        ]
    return lacking


def _one_frame(own: Mapping[NodeId, SE3], fleet: Mapping[NodeId, SE3]) -> bool:
    shared = [node for node in own if node in fleet]
    apart = (own[node].inverse() @ fleet[node] for node in shared)
    return bool(shared) and all(one.distance_m <= _SAME_FRAME_M for one in apart)


def _goals(part: Part) -> Iterator[Goal]:
    """The goals, each in a sent node; without those that none is connected with."""
    stock, sent = part.stock, part.sent
    for _, goal in sorted(stock.store.goals.items()):
        root = stock.index[goal.node]
        if sent[root]:
            yield goal
            continue
        tree = stock.graph.chains_from(root)
        near = next((int(node) for node in tree.nodes if sent[node]), None)
        if near is not None:
            near_from_goal = tree.pose(near).inverse() @ goal.node_from_goal
            yield Goal(goal.name, stock.node_ids[near], near_from_goal)
