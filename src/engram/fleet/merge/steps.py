"""MERGE: adds the missing parts of a robot's map to the fleet map (method §7, [G16] §V-A)."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from engram import __version__
from engram.config import to_dict
from engram.counts import counted
from engram.fleet.merge.checks import check_fits, check_readable, notes
from engram.fleet.merge.gate import Gate
from engram.fleet.merge.geometry import GeometryGate
from engram.fleet.merge.positions import recomposed, uncertainty_m2
from engram.fleet.merge.replay import Replay
from engram.fleet.merge.report import MergeReport
from engram.fleet.merge.segments import Segment, string_segments
from engram.fleet.merge.settings import MergeOptions
from engram.fleet.merge.state import Merge
from engram.frontend import DescriptorKind
from engram.graph.attempts import Attempts
from engram.graph.model import Node, PathEntry, Session, SessionId, path_id
from engram.maps import Map, moves
from engram.monitor import Monitor
from engram.places import RECOGNISERS
from engram.places.words import NodeWords, vocabulary_or_default
from engram.robot import Settings
from engram.robot.localisers import drives_of


@dataclass(frozen=True, slots=True)
class Gates:
    """The gates of a merge.

    Attributes:
        held_out: held-out drives must not localise worse; None for no such check.
        geometry: looks for wrong edges; None for no look.
    """

    held_out: Gate | None = None
    geometry: GeometryGate | None = None

    def any(self) -> bool:
        """Whether there is anything to pass."""
        return self.held_out is not None or self.geometry is not None

    def look_at(self, place: Path, monitor: Monitor) -> None:
        """Looks at the fleet map before the first merge."""
        for gate in (self.held_out, self.geometry):
            if gate is not None:
                gate.look_at(place, monitor)

    def check(self, merge: Merge, monitor: Monitor) -> None:
        """Checks the open revision of a merge.

        Raises:
            RefusedError: it does not pass.
        """
        centre, source = merge.centre, merge.robot.location
        if self.held_out is not None:
            merge.report.held_out = self.held_out(centre, source, monitor)
        if self.geometry is not None:
            merge.report.wrong_edges = self.geometry(centre, source, monitor)


def merge_one(
    centre: Map,
    robot: Map,
    settings: Settings,
    options: MergeOptions,
    gates: Gates,
    monitor: Monitor,
) -> MergeReport:
    """Merges one robot's map into the fleet map: one revision, or none if nothing is new.

    Args:
        centre: the fleet map, open for writing.
        robot: the robot's map.
        settings: of localiser, mapper and map frame.
        options: policy and budget.
        gates: check the result before it is committed.
        monitor: receives progress; its `check` is called wherever the merge can still be undone.

    Raises:
        IncompatibleError: the map does not fit the fleet map.
        RefusedError: the gate refuses the result. The fleet map is unchanged.
        MapError: a map cannot be read or written. The fleet map is unchanged.
    """
    merge = Merge(centre, robot)
    check_fits(merge)
    report, before = merge.report, len(merge.graph)
    report.notes = notes(merge, time.time_ns())
    nodes = robot.graph.nodes
    new = [node for node in nodes if not merge.knows(node.id)]
    report.known_omissions = sum(merge.has_omitted(node.id) for node in nodes)
    report.known = len(nodes) - len(new) - report.known_omissions
    report.changed = bool(new) or merge.has_more()
    if report.changed:
        check_readable(robot, new)
        places, goals = centre.placements, list(centre.goals.values())
        with centre.begin_revision(**_about(merge, new, settings, options)) as merge.writer:
            with monitor.stage(f"merge {robot.location}", len(new)) as stage:
                _take_over(merge, new, Replay(merge, settings, options, stage))
            monitor.check()
            if gates.any():
                merge.writer.checkpoint()
                gates.check(merge, monitor)
                monitor.check()
            report.revision = merge.writer.commit(settings.placing).number
        report.moved = moves(places, centre.placements, goals)
        if options.relocaliser in RECOGNISERS:  # these use the nodes' visual words
            _keep_words(merge, settings.frontend.descriptor)
    _say_what_hangs_together(merge, before)
    report.content_hash = centre.content_hash()
    return report


def _about(
    merge: Merge, new: Sequence[Node], settings: Settings, options: MergeOptions
) -> dict[str, Any]:
    """Author, message and configuration of the revision, independent of host and paths."""
    names = ", ".join(_contributors(merge, new))
    return {
        "author": options.author or names or "nobody",
        "message": f"merge {names or 'a map without drives'}",
        "configuration": {
            "merge": {"source": merge.report.source_hash, **to_dict(options)},
            "settings": to_dict(settings),
            "engram": __version__,
        },
    }


def _contributors(merge: Merge, new: Sequence[Node]) -> list[str]:
    """Robots whose drives bring new nodes or paths; all robots if none does."""
    saved, paths = {node.session for node in new}, merge.robot.path_memory
    driven = {
        path
        for path in paths.paths
        if any(merge.new_entry(one) or not merge.knows(one.node) for one in paths.entries(path))
    }
    found = {
        one.robot
        for one in merge.sessions
        if one.id not in merge.centre.sessions or one.id in saved or path_id(one.id) in driven
    }
    return sorted(found) or list(merge.report.robots)


def _take_over(merge: Merge, new: Sequence[Node], replay: Replay) -> None:
    """The steps of method §7 in order."""
    _take_vocabulary(merge)
    segments: dict[SessionId, list[Segment]] = defaultdict(list)
    for segment in string_segments(new, merge.edges):
        segments[segment.nodes[0].session].append(segment)
    late: list[PathEntry] = []
    for session in merge.sessions:
        _add_session(merge, session)
        for segment in segments[session.id]:
            merge.report.segments.append(replay.segment(session, segment))
        late += _unite_path(merge, session, replay)
    for amendment in merge.robot.amendments:
        merge.writer.add_amendment(amendment)
    merge.add_entries(late)
    _see_edges_again(merge)
    for edge in filter(merge.lacks_edge, merge.edges):
        merge.add_edge(edge)  # the robot's new edges between known nodes
    _join_components(merge)
    _carry_omissions(merge)
    _carry_attempts(merge, replay)
    for removal in merge.new_removals():
        merge.writer.add_mark(removal)
    for goal in merge.new_goals():
        merge.writer.add_mark(goal)
    merge.report.taken = sum(one.taken for one in merge.report.segments)
    merge.report.omitted += sum(one.omitted for one in merge.report.segments)


def _take_vocabulary(merge: Merge) -> None:
    """Copies the robot's vocabulary if the fleet map has none."""
    theirs = merge.robot.vocabulary
    if theirs is not None and merge.centre.vocabulary is None:
        merge.writer.put_vocabulary(theirs)


def _add_session(merge: Merge, session: Session) -> None:
    robot = merge.robot
    descriptor, frontend = robot.frontends[session.id]
    merge.report.sessions += merge.writer.add_session(
        session,
        robot.cameras[session.camera],
        descriptor=descriptor,
        frontend=frontend,
        partial=path_id(session.id) in robot.partial_paths,
    )
    merge.centre.derived(drives_of)[session.id] = session


def _unite_path(merge: Merge, session: Session, replay: Replay) -> list[PathEntry]:
    """Adds the drive's path as far as its nodes are known; returns the other entries."""
    entries = merge.robot.path_memory.entries(path_id(session.id))
    merge.add_entries([one for one in entries if merge.knows(one.node)])
    merge.add_entries(replay.entries.get(session.id, []))
    return [one for one in entries if not merge.knows(one.node)]


def _see_edges_again(merge: Merge) -> None:
    """Adds the edges of nodes that a revert had hidden and this merge shows again."""
    if not merge.writer.shows_again:
        return
    merge.writer.checkpoint()
    graph, edges = merge.graph, merge.centre.load().edges
    graph.add_edges([one for one in edges if graph.find_edge(one.a, one.b, one.kind) is None])


def _join_components(merge: Merge) -> None:
    """Joins components of the fleet map that only omitted nodes connect."""
    from scipy.cluster.hierarchy import DisjointSet

    labels, index = merge.graph.components(), merge.graph.index
    edges = []
    for edge in merge.edges:
        a, b = merge.equivalent(edge.a), merge.equivalent(edge.b)
        moved = None if a is None or b is None else recomposed(edge, a, b)
        if moved is not None and labels[index(moved.a)] != labels[index(moved.b)]:
            edges.append(moved)
    edges.sort(key=lambda edge: (uncertainty_m2(edge.covariance), edge.a, edge.b))
    joined = DisjointSet(labels.tolist())
    for edge in edges:
        if joined.merge(int(labels[index(edge.a)]), int(labels[index(edge.b)])):
            merge.add_edge(edge)


def _carry_omissions(merge: Merge) -> None:
    """Copies the omissions of a robot's map that is itself a merge."""
    for omitted in sorted(merge.robot.omissions):
        position = merge.lacks_omission(omitted)
        if position is not None:
            merge.omit(omitted, position, merge.robot.omissions[omitted].landmark_hash)
            merge.report.omitted += 1


def _carry_attempts(merge: Merge, replay: Replay) -> None:
    """Copies remembered attempts (method §7.4), and those of the replay."""
    sessions, remembered = list(merge.centre.sessions), merge.centre.attempts
    if merge.writer.shows_again:
        # A node that is shown again brings back its remembered attempts.
        merge.writer.checkpoint()
        now = merge.centre.load()
        sessions, remembered = [session.id for session in now.sessions], now.attempts
    new = merge.new_attempts(sessions, remembered)
    merge.report.attempts += len(new)
    ids = [
        node.id if at is None else at.node
        for node in merge.robot.graph.nodes
        for at in [merge.equivalent(node.id)]
    ]
    place = {session: at for at, session in enumerate(merge.robot.sessions)}
    for session in merge.sessions:
        own = new.rows(new.session == place[session.id])
        merge.writer.copy_attempts(session.id, own, ids)
        replayed, nodes = Attempts.of(replay.attempts.get(session.id, []))
        merge.writer.copy_attempts(session.id, replayed, nodes)


def _keep_words(merge: Merge, descriptor: DescriptorKind) -> None:
    """Copies the robot's words of the fleet map's vocabulary, and computes the missing ones.

    Words belong to no revision: if this is interrupted, they are computed later.
    """
    vocabulary, graph = vocabulary_or_default(merge.centre, descriptor), merge.graph
    theirs = NodeWords.of_map(merge.robot, vocabulary)
    robot = merge.robot.graph  # nodes hidden there were not checked
    brought = {node: one for node, one in theirs.kept.items() if node in graph and node in robot}
    if brought:
        merge.centre.put_words(theirs.hash, brought)
    NodeWords.of_map(merge.centre, vocabulary).keep_missing([node.id for node in graph.nodes])


def _say_what_hangs_together(merge: Merge, before: int) -> None:
    """Counts the components of the fleet map, and notes added nodes that are not connected to it.

    Args:
        merge: the finished merge.
        before: number of nodes before the merge.
    """
    report, labels = merge.report, merge.graph.components()
    report.components = int(labels.max(initial=-1)) + 1
    if not (report.taken and before):
        return
    apart = ~np.isin(labels[before:], labels[:before])
    if apart.all() and not report.known:
        report.notes.append(
            "none of its nodes matched the fleet map: it shows another area, or this one in "
            "other conditions"
        )
    elif apart.any():
        report.notes.append(
            f"not connected to the existing map: {counted(int(apart.sum()), 'added node')}; no "
            "match links them to it, or odometry failed in between"
        )
