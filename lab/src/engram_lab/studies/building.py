"""One map per fold, in the order of time (method §8), and its edges held against the truth."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from engram.config import to_dict
from engram.errors import InputError
from engram.geometry.se3 import SE3
from engram.graph.model import Edge, EdgeKind, NodeId
from engram.localiser.localisation import Position
from engram.maps.map import Map
from engram.robot.mapping import Beginning, MapReport, map_drive
from engram.robot.settings import RobotOptions, Settings
from engram_lab.studies.drives import EvaluatedDrive, TrueNodes
from engram_lab.studies.in_force import Values, of_revision, of_robot

# Enough for every candidate that matters; counts only, so that the same drives give the same map.
# Folds are built beside each other, one thread each.
GENEROUS = RobotOptions(ranking="path-near", lanes=4, rounds=8, relocaliser="fabmap", threads=5)


@dataclass(frozen=True, slots=True)
class BuiltSession:
    """What adding one training session came to.

    Attributes:
        frames, attempts, proposed, lookups: how many frames, match attempts, those of them at nodes
            proposed to a lost robot, and frames for which the relocaliser was asked: what it took,
            on whatever machine.
    """

    name: str
    revision: int
    nodes: int
    share_localised: float
    seconds: float
    frames: int = 0
    attempts: int = 0
    proposed: int = 0
    lookups: int = 0


@dataclass(slots=True)
class BuiltMap:
    """A fold's map."""

    path: Path
    sessions: list[BuiltSession] = field(default_factory=list)
    in_force: Values = field(default_factory=dict)

    def revision_after(self, sessions: int) -> int:
        """The revision that holds the first so many training sessions."""
        return self.sessions[sessions - 1].revision


def build_map(
    path: Path,
    drives: Sequence[EvaluatedDrive],
    settings: Settings,
    options: RobotOptions,
    *,
    base: Path | None = None,
    known: Sequence[EvaluatedDrive] = (),
    look_at: Callable[[EvaluatedDrive, MapReport], None] | None = None,
) -> BuiltMap:
    """Maps the drives one after another; continues where an earlier run stopped.

    A session is mapped in a copy that takes the map's place when it is whole, so that a map that
    was built with interruptions is the same as one that was not.

    Args:
        base: the map to which the drives are added; None for an empty one.
    """
    built = read_built_map(path)
    for drive in drives[len(built.sessions) :]:
        started = time.perf_counter()
        draft = path.with_name(f"{path.stem}.draft{path.suffix}")
        _remove(draft)
        before = path if built.sessions else base
        if before is not None:
            shutil.copyfile(before, draft)
        begin = partial(_begin, built, drive=drive, drives=(*drives, *known))
        log = drive.log()
        try:
            report = map_drive(draft, log, settings, options, begin=begin)
        finally:
            log.close()
        if report.interrupted or report.revision is None:
            raise KeyboardInterrupt
        seconds = time.perf_counter() - started
        if look_at is not None:
            look_at(drive, report)
        built.sessions.append(_built_session(draft, drive, report, seconds))
        built.in_force = {**newest_in_force(draft), **built.in_force}
        # The record first: where a run is killed between the two it is ahead of the map, and what
        # it is ahead by is done again.
        recorded = {"sessions": to_dict(built.sessions), "in_force": built.in_force}
        write_json(path.with_suffix(".json"), recorded)
        draft.replace(path)
        _remove(draft)
    return built


def _built_session(
    draft: Path, drive: EvaluatedDrive, report: MapReport, seconds: float
) -> BuiltSession:
    assert report.revision is not None
    localisations = report.results
    with Map.open(draft) as store:
        nodes = store.node_count()
    return BuiltSession(
        drive.name,
        report.revision,
        nodes,
        sum(one.localised for one in report.results) / max(len(report.results), 1),
        round(seconds, 3),
        frames=len(localisations),
        attempts=sum(one.attempts for one in localisations),
        proposed=sum(one.proposed for one in localisations),
        lookups=sum("places" in one.stage_ms for one in localisations),
    )


def read_built_map(path: Path) -> BuiltMap:
    """How far a fold's map is; nothing where it was not begun."""
    recorded = read_record(path)
    if not (recorded.sessions and path.exists()):
        return BuiltMap(path)
    with Map.open(path) as store:
        newest = store.revision
    return replace(recorded, sessions=[one for one in recorded.sessions if one.revision <= newest])


def read_record(path: Path) -> BuiltMap:
    """The record stored with a map, read without the map."""
    record = path.with_suffix(".json")
    if not record.exists():
        return BuiltMap(path)
    try:
        known = json.loads(record.read_text(encoding="utf-8"))
        sessions = [BuiltSession(**one) for one in known["sessions"]]
        return BuiltMap(path, sessions, dict(known.get("in_force", {})))
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(
            f"{record} does not show how far {path.name} is ({error}); remove both, and the same "
            "command builds the map again"
        ) from error


def newest_in_force(path: Path) -> Values:
    """What a map keeps of how its newest revision was made."""
    with Map.open(path) as store:
        return of_revision(store.log()[-1].configuration)


def _begin(
    built: BuiltMap, begun: Beginning, drive: EvaluatedDrive, drives: Sequence[EvaluatedDrive]
) -> None:
    """Records the robot's resolved settings, and sets its position."""
    built.in_force = of_robot(begun.robot)
    _place(begun, drive, drives)


def _place(begun: Beginning, drive: EvaluatedDrive, drives: Sequence[EvaluatedDrive]) -> None:
    """Sets the robot's position at the start, by truth, where that and a node there are known."""
    truth = drive.truth()
    if truth is None or begun.resumed:
        return
    log = drive.log()
    try:
        first = truth.at(int(log.stamps_ns[0]))
    finally:
        log.close()
    start = None if first is None else true_nodes(begun.opened, drives).start(first)
    if start is not None:
        begun.robot.place_at(start)


def true_nodes(opened: Map, drives: Sequence[EvaluatedDrive]) -> TrueNodes:
    """True poses of a map's nodes; `drives` are at least those that it was built from."""
    sessions = {node.session for node in opened.graph.nodes}
    truths = {one.session.id: one.truth() for one in drives if one.session.id in sessions}
    return TrueNodes(opened, truths)


def write_json(path: Path, values: Any) -> None:
    """Writes a file in one step."""
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    draft.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    draft.replace(path)


def _remove(path: Path) -> None:
    for one in path.parent.glob(f"{path.name}*"):
        one.unlink()


# An edge joins two places if it is further off than this, and than three standard deviations.
OTHER_PLACE_M = 5.0


@dataclass(frozen=True, slots=True)
class EdgeError:
    """How wrong an edge is.

    Attributes:
        error_m: how far off it is, metres.
        joins_places: whether it joins two places, which ruins a map. Where odometry had
            lost track, edges are far off and say so.
    """

    kind: EdgeKind
    error_m: float
    joins_places: bool


def edge_errors(
    edges: Iterable[Edge], world_from_node: Callable[[NodeId], SE3 | None]
) -> Iterator[EdgeError]:
    """The errors of the edges between nodes whose true poses are known.

    Args:
        world_from_node: true pose of a node; None where it is not known.
    """
    for edge in edges:
        a, b = world_from_node(edge.a), world_from_node(edge.b)
        if a is None or b is None:
            continue
        error_m = (edge.a_from_b.inverse() @ (a.inverse() @ b)).distance_m
        sigma_m = Position(edge.a, edge.a_from_b, edge.covariance).sigma_m
        yield EdgeError(edge.kind, error_m, error_m > max(OTHER_PLACE_M, 3 * sigma_m))
