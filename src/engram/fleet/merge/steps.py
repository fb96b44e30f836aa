"""MERGE: what a robot has seen and the centre is lacking joins the centre (SPEC §7, [G16] §V-A)."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram import __version__
from engram.config import to_dict
from engram.fleet.merge.attempts import at_equivalents, from_records, lacking
from engram.fleet.merge.centre import Centre, LazyRelocaliser
from engram.fleet.merge.checks import check_fits, check_readable, notes
from engram.fleet.merge.handed_in import HandedIn
from engram.fleet.merge.positions import recomposed, uncertainty_m2
from engram.fleet.merge.replay import MergeOptions, Replay
from engram.fleet.merge.report import HeldOutReport, MergeReport
from engram.fleet.merge.segments import Segment, string_segments
from engram.fleet.merge.words import keep_words
from engram.graph.model import (
    Edge,
    EdgeKind,
    Node,
    NodeId,
    PathEntry,
    Session,
    SessionId,
    path_id,
)
from engram.localiser import Position
from engram.maps import AttemptArrays, BulkWriter, MapStore, WritableMapStore
from engram.monitor import Monitor
from engram.places import RECOGNISERS
from engram.robot import Settings

# Relocalisers that know places by their words.
_BY_WORDS = frozenset(RECOGNISERS)
Gate: TypeAlias = Callable[[MapStore, str, Monitor], HeldOutReport]


def merge_one(
    store: WritableMapStore,
    robot: HandedIn,
    settings: Settings,
    options: MergeOptions,
    gate: Gate | None,
    monitor: Monitor,
) -> MergeReport:
    """Merges one robot's map into the centre: one revision, or none where nothing is new.

    Args:
        store: the centre.
        robot: the map handed in.
        settings: of localiser and mapper.
        options: policy and budget.
        gate: is shown the result before it becomes part of the centre, with the map's name; it
            says what it found, or raises to refuse it.
        monitor: sees how it goes, and is asked where the merge can still be given up.

    Raises:
        IncompatibleError: the map does not fit the centre.
        MapError: a map cannot be read or written. The centre is as it was.
    """
    centre = Centre(store)
    check_fits(centre, robot)
    centre_nodes = len(centre.graph)
    report = MergeReport(robot.name, robot.content_hash, robot.robots)
    report.notes = notes(centre, robot, time.time_ns())
    new = [node for node in robot.contents.nodes if not centre.knows(node.id)]
    report.known_omissions = sum(centre.has_omitted(node) for node in robot.nodes)
    report.known = len(robot.nodes) - len(new) - report.known_omissions
    if new or _has_more(centre, robot):
        check_readable(robot, new)
        with store.begin_revision(**_about(robot, settings, options)) as writer:
            merging = _Merging(centre, robot, writer, settings, options, report)
            merging.take_over(new, monitor)
            monitor.check()
            if gate is not None:
                writer.flush()
                report.held_out = gate(store, robot.name, monitor)
                monitor.check()
            report.revision = writer.commit().number
        if options.relocaliser in _BY_WORDS:
            keep_words(store, centre, robot, settings.frontend.descriptor)
    labels = centre.graph.components()
    report.components = int(labels.max(initial=-1)) + 1
    if report.taken and centre_nodes:
        apart = ~np.isin(labels[centre_nodes:], labels[:centre_nodes])
        report.notes += _parts_apart(apart, report)
    report.content_hash = store.content_hash()
    return report


def _parts_apart(apart: NDArray[np.bool_], report: MergeReport) -> list[str]:
    """Says so where what was taken hangs together with nothing that the centre had.

    Args:
        apart: (taken,) whether each new node lies in a part of the map that is new altogether.
        report: counts so far.
    """
    if not apart.any():
        return []
    if apart.all() and not report.known:
        return ["no node of it was found in the centre: another town, or another look of this one"]
    return [
        f"{int(apart.sum())} of the nodes taken hang together with nothing that the centre had: "
        "their way there was not found, or odometry had lost track on it"
    ]


def _about(robot: HandedIn, settings: Settings, options: MergeOptions) -> dict[str, Any]:
    """Who merged what and how: kept with the revision, and free of where it happened."""
    names = ", ".join(robot.robots)
    return {
        "author": options.author or names or "nobody",
        "message": f"merge {names or 'a map without drives'}",
        "configuration": {
            "merge": {"source": robot.content_hash, **to_dict(options)},
            "settings": to_dict(settings),
            "engram": __version__,
        },
    }


def _has_more(centre: Centre, robot: HandedIn) -> bool:
    """Whether a map without new nodes has anything else to say."""
    return (
        any(session.id not in centre.opened.sessions for session in robot.sessions)
        or any(centre.new_entry(entry) for entry in robot.contents.path_entries)
        or any(_is_new(centre, edge) for edge in robot.edges)
        or any(_carries(centre, robot, omitted) for omitted in robot.omissions)
        or len(_new_attempts(centre, robot, centre.opened.sessions, centre.opened.remembered)) > 0
    )


class _Merging:
    """One robot's map on its way into the centre."""

    def __init__(
        self,
        centre: Centre,
        robot: HandedIn,
        writer: BulkWriter,
        settings: Settings,
        options: MergeOptions,
        report: MergeReport,
    ) -> None:
        self._centre = centre
        self._robot = robot
        self._writer = writer
        self._settings = settings
        self._options = options
        self._report = report

    def take_over(self, new: list[Node], monitor: Monitor) -> None:
        """The steps of SPEC §7 MERGE, in order."""
        self._take_vocabulary()
        with monitor.stage(f"merge {self._robot.name}", len(new)) as stage:
            replay = self._replay(stage)
            late: list[PathEntry] = []
            segments: dict[SessionId, list[Segment]] = defaultdict(list)
            for segment in string_segments(new, self._robot.edges):
                segments[segment.nodes[0].session].append(segment)
            for session in self._robot.sessions:
                self._add_session(session)
                for segment in segments[session.id]:
                    self._report.segments.append(replay.segment(session, segment))
                late += self._unite_path(session, replay)
        self._add_entries(late)
        self._see_edges_again()
        self._take_known_edges()
        self._join_components()
        self._carry_omissions()
        self._carry_attempts(replay)
        self._report.taken = sum(one.taken for one in self._report.segments)
        self._report.omitted += sum(one.omitted for one in self._report.segments)
        self._report.edges += replay.edges
        self._report.match_attempts = replay.match_attempts
        self._report.proposed_attempts = replay.proposed_attempts
        self._report.lookups = replay.lookups

    def _replay(self, monitor: Monitor) -> Replay:
        name, descriptor = self._options.relocaliser, self._settings.frontend.descriptor
        opened = self._centre.opened
        return Replay(
            self._centre,
            self._robot,
            self._writer,
            self._settings,
            self._options,
            None
            if name is None
            else LazyRelocaliser(name, lambda: opened.relocaliser(name, descriptor)),
            monitor,
        )

    def _take_vocabulary(self) -> None:
        """A centre without a vocabulary of its own takes that of the robot."""
        theirs = self._robot.store.vocabulary()
        if theirs is not None and self._centre.store.vocabulary() is None:
            self._writer.put_vocabulary(theirs)

    def _add_session(self, session: Session) -> None:
        descriptor, frontend = self._robot.frontends[session.id]
        is_new = self._writer.add_session(
            session,
            self._robot.contents.cameras[session.camera],
            descriptor=descriptor,
            frontend=frontend,
            partial=path_id(session.id) in self._robot.partial_paths,
        )
        self._centre.opened.drives[session.id] = session
        self._report.sessions += is_new

    def _unite_path(self, session: Session, replay: Replay) -> list[PathEntry]:
        """The drive's path as far as its nodes are known; returns the entries that are not yet."""
        path = path_id(session.id)
        entries = self._robot.entries_of.get(path, [])
        known = [entry for entry in entries if self._centre.knows(entry.node)]
        self._add_entries([*known, *replay.entries.get(session.id, [])])
        return [entry for entry in entries if not self._centre.knows(entry.node)]

    def _add_entries(self, entries: list[PathEntry]) -> None:
        for entry in entries:
            new = self._centre.new_entry(entry)
            if new is not None:
                self._centre.add_entry(new)
                self._writer.add_path_entry(new)
                self._report.path_entries += 1

    def _see_edges_again(self) -> None:
        """A node that a revert had hidden brings back its edges to nodes that stayed."""
        if not self._writer.shows_again:
            return
        self._writer.flush()
        graph = self._centre.graph
        edges = self._centre.store.load().edges
        graph.add_edges([one for one in edges if graph.find_edge(one.a, one.b, one.kind) is None])

    def _take_known_edges(self) -> None:
        """What the robot found out about nodes that the centre had: matches between them."""
        for edge in self._robot.edges:
            if _is_new(self._centre, edge):
                self._add_edge(edge)

    def _join_components(self) -> None:
        """Where two parts of the centre are joined only by nodes that were not taken."""
        labels = self._centre.graph.components()
        index = self._centre.graph.index
        edges = []
        for edge in self._robot.edges:
            a, b = self._centre.equivalent(edge.a), self._centre.equivalent(edge.b)
            moved = None if a is None or b is None else recomposed(edge, a, b)
            if moved is not None and labels[index(moved.a)] != labels[index(moved.b)]:
                edges.append(moved)
        edges.sort(key=lambda edge: (uncertainty_m2(edge.covariance), edge.a, edge.b))
        joined: dict[int, int] = {}
        for edge in edges:
            ends = [_root(joined, int(labels[index(node)])) for node in (edge.a, edge.b)]
            if ends[0] != ends[1]:
                self._add_edge(edge)
                joined[max(ends)] = min(ends)

    def _add_edge(self, edge: Edge) -> None:
        self._centre.graph.add_edge(edge)
        self._writer.add_edge(edge)
        self._report.edges += 1

    def _carry_omissions(self) -> None:
        """What the robot's map had omitted itself, when it was merged from others."""
        for omitted in sorted(self._robot.omissions):
            position = _carries(self._centre, self._robot, omitted)
            if position is not None:
                landmark_hash = self._robot.omissions[omitted].landmark_hash
                self._writer.add_omission(self._centre.omit(omitted, position, landmark_hash))
                self._report.omitted += 1

    def _carry_attempts(self, replay: Replay) -> None:
        """Remembered attempts go along (SPEC §7 MERGE 4), those of the replay too."""
        opened = self._centre.opened
        sessions, remembered = list(opened.sessions), opened.remembered
        if self._writer.shows_again:
            # A node that is seen again brings back the attempts that were remembered at it.
            self._writer.flush()
            now = self._centre.store.load()
            sessions, remembered = [session.id for session in now.sessions], now.attempts
        new = _new_attempts(self._centre, self._robot, sessions, remembered)
        self._report.attempts += len(new)
        ids = [
            node.id if at is None else at.node
            for node in self._robot.contents.nodes
            for at in [self._centre.equivalent(node.id)]
        ]
        place = {session.id: at for at, session in enumerate(self._robot.contents.sessions)}
        for session in self._robot.sessions:
            own = new.rows(new.session == place[session.id])
            self._writer.add_attempts(session.id, own, ids)
            replayed, nodes = from_records(replay.attempts.get(session.id, []))
            self._writer.add_attempts(session.id, replayed, nodes)


def _root(joined: dict[int, int], label: int) -> int:
    """The component that a component has become part of."""
    while label in joined:
        label = joined[label]
    return label


def _is_new(centre: Centre, edge: Edge) -> bool:
    """An edge between two of the centre's nodes that it lacks; bridges stand for what it has."""
    return (
        edge.kind is not EdgeKind.BRIDGE
        and edge.a in centre.graph
        and edge.b in centre.graph
        and centre.graph.find_edge(edge.a, edge.b, edge.kind) is None
    )


def _new_attempts(
    centre: Centre,
    robot: HandedIn,
    sessions: Iterable[SessionId],
    remembered: AttemptArrays,
) -> AttemptArrays:
    """The robot's attempts between known nodes that the centre lacks, told from the equivalents.

    Args:
        centre: which nodes it knows.
        robot: whose attempts; `session`, `reference` and `node` of the result are indices into
            its contents.
        sessions: of the centre.
        remembered: its attempts; `session` is a place in `sessions`.
    """
    contents = robot.contents
    positions = [centre.equivalent(node.id) for node in contents.nodes]
    known = np.array([position is not None for position in positions], np.bool_)
    made = contents.attempts
    made = made.rows(known[made.reference] & known[made.node])
    place: dict[SessionId, int] = {}
    for session in (*sessions, *(one.id for one in contents.sessions)):
        place.setdefault(session, len(place))
    named = np.array([place[one.id] for one in contents.sessions], np.int32)
    new = made.rows(lacking(replace(made, session=named[made.session]), remembered))
    return at_equivalents(new, positions)


def _carries(centre: Centre, robot: HandedIn, omitted: NodeId) -> Position | None:
    """Where a node that the robot's map had omitted is in the centre; None if it needs no word."""
    omission = robot.omissions[omitted]
    known = centre.equivalent(omission.node)
    if known is None or centre.knows(omitted) or omitted in robot.nodes:
        return None
    return known.carried_on(omission.node_from_omitted, np.zeros((6, 6)))
