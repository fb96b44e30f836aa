"""MERGE: adds the missing parts of robots' maps to the fleet map (method §7, [G16] §V-A)."""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from engram import __version__
from engram.config import to_dict
from engram.counts import counted
from engram.errors import InputError
from engram.files import draft_folder
from engram.fleet.merge.gate import Gate, GeometryGate
from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.open_merge import (
    Merge,
    check_fits,
    check_readable,
    notes,
    recomposed,
    uncertainty_m2,
)
from engram.fleet.merge.replay import Replay, Segment, string_segments
from engram.fleet.merge.report import MergeReport, picture_before_and_after
from engram.frontend.frame import DescriptorKind
from engram.graph.model import Node, NodeId, PathEntry, Session, SessionId, path_id
from engram.graph.paths import Attempts
from engram.maps.map import Map
from engram.maps.map_files import copy_map, publish_map
from engram.monitor import QUIET, Monitor, interruptible
from engram.places.recognisers import recogniser_names
from engram.places.words import NodeWords, vocabulary_or_default
from engram.robot.localisers import drives_of
from engram.robot.settings import RobotOptions, Settings
from engram.viewing.drawings import check_picture


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
        """Checks the open revision of a merge."""
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

    If it raises, the fleet map is unchanged.

    Args:
        robot: the robot's map.
        settings: of localiser, mapper and map frame.
        monitor: receives progress; its `check` is called wherever the merge can still be undone.
    """
    merge = Merge(centre, robot)
    check_fits(merge)
    report, was_empty = merge.report, centre.node_count() == 0
    report.notes = notes(merge, time.time_ns())
    nodes = robot.graph.nodes
    report.forgotten = sum(map(merge.has_forgotten, nodes))
    new = [node for node in nodes if not (merge.knows(node.id) or merge.has_forgotten(node))]
    report.known_omissions = sum(merge.has_omitted(node.id) for node in nodes)
    report.known = len(nodes) - len(new) - report.known_omissions - report.forgotten
    report.changed = bool(new) or merge.has_more()
    if report.changed:
        check_readable(robot, new)
        goals = list(centre.goals.values())
        with centre.begin_revision(**_about(merge, new, settings, options)) as merge.writer:
            with monitor.stage(f"merge {robot.location}", len(new)) as stage:
                _take_over(merge, new, Replay(merge, settings, options, stage))
            monitor.check()
            if gates.any():
                merge.writer.checkpoint()
                gates.check(merge, monitor)
                monitor.check()
            report.revision = merge.writer.commit(settings.placing).number
        report.moved = centre.lookups.moves(report.revision, goals)
        if options.relocaliser in recogniser_names():  # these use the nodes' visual words
            _keep_words(merge, settings.frontend.descriptor)
    report.components = centre.totals().components
    if not was_empty:
        _say_what_is_apart(merge)
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
        if any(
            merge.new_entry(entry) or not merge.knows(entry.node) for entry in paths.entries(path)
        )
    }
    robots = {
        session.robot
        for session in merge.sessions
        if session.id not in merge.centre.sessions
        or session.id in saved
        or path_id(session.id) in driven
    }
    return sorted(robots) or list(merge.report.robots)


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
    for amendment in merge.amendments:
        merge.writer.add_amendment(amendment)
    merge.add_entries(late)
    if merge.writer.shows_again:
        merge.see_edges_again()
    for edge in filter(merge.lacks_edge, merge.edges):
        merge.add_edge(edge)  # the robot's new edges between known nodes
    _join_components(merge)
    _carry_omissions(merge)
    _carry_attempts(merge, replay)
    for removal in merge.new_removals():
        merge.writer.add_mark(removal)
    for goal in merge.new_goals():
        merge.writer.add_mark(goal)
    merge.report.taken = sum(segment.taken for segment in merge.report.segments)
    merge.report.omitted += sum(segment.omitted for segment in merge.report.segments)


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
    merge.add_entries([entry for entry in entries if merge.knows(entry.node)])
    merge.add_replayed(replay.entries.get(session.id, []))
    return [entry for entry in entries if not merge.knows(entry.node)]


def _join_components(merge: Merge) -> None:
    """Joins components of the fleet map that only omitted nodes connect."""
    from scipy.cluster.hierarchy import DisjointSet

    edges = []
    for edge in merge.edges:
        a, b = merge.equivalent(edge.a), merge.equivalent(edge.b)
        moved = None if a is None or b is None else recomposed(edge, a, b)
        if moved is not None:
            edges.append(moved)
    edges.sort(key=lambda edge: (uncertainty_m2(edge.covariance), edge.a, edge.b))
    ends = {end for pair in merge.joined for end in pair}
    ends |= {end for edge in edges for end in (edge.a, edge.b)}
    part = _parts_before(merge, ends)
    joined: DisjointSet = DisjointSet(part.values())
    for a_end, b_end in merge.joined:
        joined.merge(part[a_end], part[b_end])
    for edge in edges:
        if joined.merge(part[edge.a], part[edge.b]):
            merge.add_edge(edge)


def _parts_before(merge: Merge, nodes: set[NodeId]) -> dict[NodeId, NodeId | int]:
    """The component of each node before this merge; of one taken since, the node itself."""
    part: dict[NodeId, NodeId | int] = {node: node for node in nodes}
    held = merge.centre.lookups.nodes(nodes - merge.taken)
    keys = np.array([one.key for one in held.values()], np.int64)
    components = merge.runs.component[merge.runs.find(keys)].tolist()
    return part | dict(zip(held, components, strict=True))


def _carry_omissions(merge: Merge) -> None:
    """Copies the omissions of a robot's map that is itself a merge."""
    for omitted in sorted(merge.robot.omissions):
        position = merge.lacks_omission(omitted)
        if position is not None:
            merge.omit(omitted, position, merge.robot.omissions[omitted].landmark_hash)
            merge.report.omitted += 1


def _carry_attempts(merge: Merge, replay: Replay) -> None:
    """Copies remembered attempts (method §7.4), and those of the replay."""
    if merge.writer.shows_again:
        merge.writer.checkpoint()  # a node that is shown again brings back its attempts
    new = merge.new_attempts()
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
    vocabulary = vocabulary_or_default(merge.centre, descriptor)
    nodes = [node.id for node in merge.robot.graph.nodes if merge.has(node.id)]
    theirs = NodeWords.of_map(merge.robot, vocabulary)
    NodeWords.of_map(merge.centre, vocabulary).keep_missing(nodes, brought=theirs)


def _say_what_is_apart(merge: Merge) -> None:
    """Notes added nodes that are not connected to the earlier fleet map."""
    report, apart = merge.report, sum(map(merge.is_apart, merge.taken))
    if apart and apart == len(merge.taken) and not report.known:
        report.notes.append(
            "none of its nodes matched the fleet map: it shows another area, or this one in "
            "other conditions"
        )
    elif apart:
        report.notes.append(
            f"not connected to the existing map: {counted(apart, 'added node')}; no "
            "match links them to it, or odometry failed in between"
        )


def merge(
    centre: Path,
    robots: Sequence[Path],
    options: MergeOptions | None = None,
    monitor: Monitor = QUIET,
    *,
    settings: Settings | None = None,
    dry_run: bool = False,
    require_better: Sequence[Path] = (),
    localising: RobotOptions | None = None,
    picture: Path | None = None,
    geometry: GeometryGate | None = None,
) -> list[MergeReport]:
    """Merges robots' maps into the fleet map, in the order given; creates it if missing.

    Each robot's map is one merge: one revision, all or nothing. Merging again changes nothing, so
    an interrupted command is run again. Ctrl-C takes effect after the current node or
    held-out frame, and undoes the current merge.

    Args:
        centre: the fleet's map, NAME.engram.
        robots: the maps to merge.
        options: policy and budget.
        monitor: receives progress, and each report as soon as its map is merged.
        settings: the resolved configuration, kept with the revision; None for the defaults.
        dry_run: merge into a copy of the fleet map and discard it.
        require_better: held-out drives that must not localise worse in the result.
        localising: policy and budget of these drives; None for the defaults.
        picture: an image file for a plan view of the fleet map before and after.
        geometry: looks for wrong edges in each result; None for no look.

    Returns:
        One report for each map, up to the one in which the command was interrupted.

    Raises:
        InputError: the fleet map itself is among `robots`, a held-out path is not a drive, or the
            picture cannot be written there. Nothing was merged.
        ConfigError: a drive is not held out. Nothing was merged.
        IncompatibleError: a map does not fit the fleet map.
        RefusedError: held-out drives localise worse in the result, or it has new wrong edges.
        MapError: a map cannot be read or written. If one cannot be opened, nothing was merged;
            otherwise earlier merges are kept.
        KeyboardInterrupt: Ctrl-C came before the first merge or after the last one, so there was
            none to undo.
    """
    options, settings = options or MergeOptions(), settings or Settings()
    if picture is not None:
        check_picture(picture)
    gate = Gate(require_better, settings, localising) if require_better else None
    gates = Gates(gate, geometry)
    _check_given(centre, robots, gate)
    reports: list[MergeReport] = []
    with _place(centre, dry_run=dry_run) as drafted:
        place = drafted
        with Map.open(place) as store:
            before = store.revision
        # One for all robots, so that a Ctrl-C at the end of a merge is not lost.
        with interruptible(monitor) as watched:
            gates.look_at(place, watched)
            for robot in robots:
                reports.append(_merged(place, robot, settings, options, gates, watched))
                if dry_run:
                    reports[-1].dry_run, reports[-1].revision = True, None
                if not (reports[-1].interrupted or dry_run or place == centre):
                    publish_map(place, centre)
                    place = centre
                watched.hear(reports[-1])
                if reports[-1].interrupted:
                    break
            else:
                watched.check()
        if picture is not None:
            picture_before_and_after(place, before, picture)
    return reports


def _check_given(centre: Path, robots: Sequence[Path], gate: Gate | None) -> None:
    """Checks all arguments before anything is made or changed."""
    for robot in robots:
        with Map.open(robot) as store:
            if centre.exists() and robot.samefile(centre):
                raise InputError(f"{robot} is the fleet map itself; name other maps to merge")
            sessions = list(store.sessions.values())
        if gate is not None:
            gate.check_held_out(sessions, robot)
    if gate is not None and centre.exists():
        with Map.open(centre) as store:
            gate.check_held_out(store.sessions.values(), centre)


def _merged(
    place: Path,
    path: Path,
    settings: Settings,
    options: MergeOptions,
    gates: Gates,
    monitor: Monitor,
) -> MergeReport:
    """One merge in a freshly opened map, so that the result does not depend on earlier ones."""
    started = time.perf_counter()
    with Map.open(path) as robot:
        try:
            monitor.check()
            with Map.open(place, writes=True) as store:
                settings = settings.for_descriptor(robot.descriptor)
                report = merge_one(store, robot, settings, options, gates, monitor)
            if report.revision is None:
                monitor.check()
        except KeyboardInterrupt:
            report = replace(MergeReport.of(robot), interrupted=True)
            with Map.open(place) as store:
                report.content_hash = store.content_hash()
    report.seconds = time.perf_counter() - started
    return report


@contextmanager
def _place(centre: Path, *, dry_run: bool) -> Iterator[Path]:
    """The fleet map, a copy of it for a dry run, or the draft of a new one."""
    if centre.exists() and not dry_run:
        yield centre
    elif dry_run:
        with tempfile.TemporaryDirectory(prefix="engram-dry-run-") as folder:
            copy = Path(folder) / centre.name
            if centre.exists():
                copy_map(centre, copy)
            else:
                Map.create(copy).close()
            yield copy
    else:
        with draft_folder(centre) as folder:
            draft = folder / centre.name
            Map.create(draft).close()
            yield draft
