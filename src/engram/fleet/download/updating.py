"""A download taken into a map that the robot keeps ([G16] Fig. 3c and Fig. 9).

The robot's map gains what is new in the download, as one revision: nodes by UUID, edges by
ends and kind, path entries by path and sequence, attempts by `Attempts.lacking`. Nothing is
replayed and nothing is removed. The robot's own nodes that the fleet map omitted stay, and are tied
to their equivalents. Killed at any moment, the map is as before or as after.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from engram.config import plain
from engram.counts import counted
from engram.errors import IncompatibleError, InputError
from engram.files import draft_folder
from engram.fleet.download.downloading import choose_part, revision_of, stocked
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.part import Mask, Part, lacking_marks
from engram.fleet.download.selections import SELECTIONS, check_options, facts_told
from engram.fleet.forgetting import bridges_over
from engram.fleet.merge.open_merge import FIRST_REPLAYED, position_of, uncertainty_m2
from engram.graph.model import (
    Edge,
    EdgeKind,
    NodeId,
    PathEntry,
    PathEntryKind,
    PathId,
    Removed,
    Session,
    SessionId,
)
from engram.maps.forgetting import Chosen
from engram.maps.map import Map
from engram.maps.records import MapContents
from engram.maps.writer import RevisionWriter
from engram.monitor import QUIET, Monitor


@dataclass(frozen=True, slots=True, eq=False)
class UpdateReport:
    """What an update added to a robot's map.

    Attributes:
        out: the robot's map.
        select: key of `SELECTIONS`.
        revision: the new one of the robot's map; None if nothing was missing.
        content_hash: of the robot's map.
        nodes, of_nodes: copied; those of the download.
        own_nodes: nodes of the robot's map that the download does not have.
        ties: new edges between own nodes and the nodes by which the fleet map replaced them.
        forgotten: own nodes that the robot's map forgets, too, since the fleet map has.
    """

    out: Path
    select: str
    source_revision: int
    revision: int | None
    content_hash: str
    nodes: int
    of_nodes: int
    own_nodes: int
    sessions: int
    edges: int
    path_entries: int
    attempts: int
    ties: int
    forgotten: int
    why: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """What ``download --update --json`` prints."""
        values: dict[str, Any] = plain(self)
        return values

    def text(self) -> str:
        """The report as text."""
        head = f"{self.select} of revision {self.source_revision}: {counted(self.of_nodes, 'node')}"
        if self.revision is None:
            lines = [f"{head}; {self.out.name} has them all: nothing changed"]
        else:
            lines = [
                f"{head}, {self.nodes} of them new in {self.out.name} (revision {self.revision}), "
                f"which keeps {counted(self.own_nodes, 'node')} of its own",
                f"copied {counted(self.sessions, 'session')}, {counted(self.edges, 'edge')}, "
                f"{counted(self.path_entries, 'path entry')}, {counted(self.attempts, 'attempt')}; "
                f"tied {counted(self.ties, 'own node')} to equivalents",
            ]
        if self.forgotten:
            lines.append(f"forgotten, as by the fleet: {counted(self.forgotten, 'own node')}")
        return "\n".join(lines + facts_told(self.why))


def update(
    centre: Path | str,
    robot: Path,
    options: DownloadOptions | None = None,
    *,
    at: int | str | None = None,
    monitor: Monitor = QUIET,
    message: str | None = None,
) -> UpdateReport:
    """Takes a download into a robot's map, which keeps its own nodes and history.

    Args:
        centre: the fleet map, or its address; a file that `download` wrote will do.
        robot: the robot's map, which must exist.
        options: which part of the fleet map; None for all of it.
        at: revision of the fleet map; None for the newest.
        monitor: receives progress per copied node.
        message: of the revision; None names the download.

    After any error, and after a kill, the robot's map is as it was.
    """
    options = options or DownloadOptions()
    check_options(options)
    if Path(centre).exists() and robot.exists() and robot.samefile(centre):
        raise InputError(f"{robot} is the fleet map itself; name the robot's map")
    with Map.open(centre, at=at) as store, Map.open(robot, writes=True) as own:
        stock = stocked(store, options)
        selection = SELECTIONS[options.select](stock, options)
        with draft_folder(robot) as folder:
            part, why = choose_part(stock, selection, options, folder, monitor)
        taking = _Update(part, own)
        about = revision_of(stock, options)
        revision = taking.write({**about, "message": message or about["message"]}, monitor)
        return taking.report(robot, options.select, revision, dict(why))


class _Update:
    """A part of the fleet map and the robot's map that receives it."""

    def __init__(self, part: Part, own: Map) -> None:
        self._stock = part.stock
        self._part, self._map = part.without(_forgotten_by(own, part)), own
        self._own = own.load()
        self._own_nodes = len(self._own.nodes)
        self._counts = dict.fromkeys(
            (
                "nodes",
                "sessions",
                "edges",
                "path_entries",
                "attempts",
                "ties",
                "forgotten",
            ),
            0,
        )
        _check_fits(self._part, own, self._own)
        self._forgotten = self._gone()
        self._bridges = bridges_over(own, self._forgotten)
        self._lost = {
            node.id
            for node in self._own.nodes
            if node.id in self._forgotten.nodes or node.session in self._forgotten.sessions
        }
        self._counts["forgotten"] = len(self._lost)

    def report(
        self, out: Path, select: str, revision: int | None, why: dict[str, Any]
    ) -> UpdateReport:
        return UpdateReport(
            out=out,
            select=select,
            source_revision=self._stock.store.revision,
            revision=revision,
            content_hash=self._map.content_hash(),
            of_nodes=len(self._part),
            own_nodes=self._own_nodes - (len(self._part) - self._counts["nodes"]),
            why=why,
            **self._counts,
        )

    def write(self, about: dict[str, Any], monitor: Monitor) -> int | None:
        """Writes what is missing, as one revision; returns its number, None if nothing was."""
        with self._map.begin_revision(**about) as writer:
            anything = self._write_owners(writer, monitor)
            if writer.shows_again:
                # Nodes that a revert had hidden bring their edges, entries and attempts back.
                writer.checkpoint()
                self._own = self._map.load()
            anything |= self._write_the_rest(writer)
            if self._forgotten.sessions or self._forgotten.nodes:
                writer.forget(self._forgotten, self._bridges)
                anything = True
            monitor.check()
            revision = writer.commit().number if anything else None
        if self._stock.words is not None and revision is not None:
            self._stock.words.give(self._map, self._part.node_ids)
        return revision

    def _write_owners(self, writer: RevisionWriter, monitor: Monitor) -> bool:
        partial = self._part.partial_paths()
        for session in self._part.sessions:
            self._counts["sessions"] += self._part.add_session(writer, session, partial)
        amended = [writer.add_amendment(amendment) for amendment in self._part.amendments]
        lacking = self._lacking_nodes()
        with monitor.stage("update", int(lacking.sum())) as stage:
            for stored in self._part.stored(lacking):
                writer.copy_node(stored)
                self._counts["nodes"] += 1
                stage.advance()
                stage.check()
        return any(amended) or any(self._counts.values())

    def _write_the_rest(self, writer: RevisionWriter) -> bool:
        edges = list(self._lacking_edges())
        ties = list(self._lacking_ties({_key(edge) for edge in edges}))
        entries = list(self._lacking_entries())
        attempts = self._lacking_attempts()
        known = {node.id for node in self._own.nodes} | self._map.omissions.keys()
        omissions = [
            omission for omission in self._part.omissions() if omission.omitted not in known
        ]
        for edge in (*edges, *ties):
            writer.add_edge(edge)
        for entry in entries:
            writer.add_path_entry(entry)
        self._part.write_attempts(writer, attempts)
        for omission in omissions:
            writer.add_omission(omission)
        marks = lacking_marks(self._part, self._map)
        for mark in marks:
            writer.add_mark(mark)
        vocabulary = self._stock.store.vocabulary
        learnt = vocabulary is not None and vocabulary != self._map.vocabulary
        if vocabulary is not None and learnt:
            writer.put_vocabulary(vocabulary)
        self._counts |= {
            "edges": len(edges),
            "path_entries": len(entries),
            "attempts": len(attempts),
            "ties": len(ties),
        }
        return bool(edges or ties or entries or len(attempts) or omissions or marks or learnt)

    def _gone(self) -> Chosen:
        """The own nodes and drives that the fleet has forgotten."""
        held, drives = {node.id: node for node in self._own.nodes}, set(self._map.sessions)
        gone = self._stock.store.lookups.forgotten([*held, *drives])
        alone = (one for one in held.keys() & gone if held[one].session not in gone)
        return Chosen(frozenset(drives & gone), frozenset(alone))

    def _lacking_nodes(self) -> Mask:
        known = {node.id for node in self._own.nodes}
        return np.array([node not in known for node in self._stock.node_ids], np.bool_)

    def _lacking_edges(self) -> Iterator[Edge]:
        known = {_key(edge): uncertainty_m2(edge.covariance) for edge in self._own.edges}
        removed = Removed(self._map.removals)
        for edge in self._part.edges():
            if edge not in removed and uncertainty_m2(edge.covariance) < known.get(
                _key(edge), np.inf
            ):
                yield edge

    def _lacking_ties(self, copied: set[tuple[NodeId, NodeId, EdgeKind]]) -> Iterator[Edge]:
        """Matches of own nodes with the nodes by which the fleet map replaced them."""
        known = copied | {_key(edge) for edge in self._own.edges}
        own = {node.id for node in self._own.nodes} - self._lost
        present = own | set(self._part.node_ids)
        fleet = self._stock.store.lookups
        held = fleet.nodes(own)
        for omitted, omission in sorted(fleet.omissions(own).items()):
            if omitted not in held and omission.node in present:
                at = position_of(omission)
                tie = Edge(at.node, omitted, EdgeKind.MATCH, at.node_from_live, at.covariance)
                if _key(tie) not in known:
                    yield tie

    def _lacking_entries(self) -> Iterator[PathEntry]:
        """Path entries missing from the robot's map; those of merges by node and stamp."""
        taken: dict[PathId, set[int]] = {}
        replayed = set()
        for entry in self._own.path_entries:
            taken.setdefault(entry.path, set()).add(entry.sequence)
            if entry.kind is PathEntryKind.REPLAYED:
                replayed.add((entry.path, entry.node, entry.stamp_ns))
        for entry in self._part.entries():
            sequences = taken.setdefault(entry.path, set())
            new = entry
            if entry.kind is PathEntryKind.REPLAYED:
                if (entry.path, entry.node, entry.stamp_ns) in replayed:
                    continue
                if entry.sequence in sequences:
                    new = replace(entry, sequence=max(FIRST_REPLAYED, max(sequences) + 1))
            if new.sequence not in sequences:
                sequences.add(new.sequence)
                yield new

    def _lacking_attempts(self) -> NDArray[np.intp]:
        """Rows of the stock's attempts that the robot's map does not remember."""
        rows = self._part.attempt_rows()
        made, remembered = self._stock.attempts.rows(rows), self._own.attempts
        place: dict[Any, int] = {}
        for session in (*self._own.sessions, *self._stock.sessions):
            place.setdefault(session.id, len(place))
        named = np.array([place[session.id] for session in self._stock.sessions], np.int32)
        theirs = replace(made, session=named[made.session])
        return rows[theirs.lacking(remembered)]


def _forgotten_by(own: Map, part: Part) -> frozenset[UUID]:
    """What a robot's map has forgotten of a part: only its own revert brings that back."""
    stock = part.stock
    ids: list[SessionId | NodeId] = [one.id for one in stock.sessions]
    ids += [*stock.node_ids, *(one.omitted for one in part.omissions())]
    return own.lookups.forgotten(ids)


def _key(edge: Edge) -> tuple[NodeId, NodeId, EdgeKind]:
    return edge.a, edge.b, edge.kind


def _check_fits(part: Part, own: Map, contents: MapContents) -> None:
    known = {session.id: session.as_recorded for session in contents.sessions}
    for session in part.sessions:
        ours = known.get(session.id)
        if ours is not None and not _same_drive(ours, session.as_recorded):
            raise IncompatibleError(
                f"session {session.id} is a drive of {ours.robot} in {own.location} and another "
                f"one, of {session.robot}, in the fleet map: one of the two maps is wrong"
            )
    ours_of = own.landmark_hashes
    theirs_of = part.stock.store.lookups.landmark_hashes(part.node_ids)
    for node in part.node_ids:
        if ours_of.get(node, theirs_of[node]) != theirs_of[node]:
            raise IncompatibleError(
                f"node {node} has landmarks {ours_of[node].hex()} in {own.location} and "
                f"{theirs_of[node].hex()} in the fleet map: a node never changes, so one of the "
                "two maps is wrong"
            )


def _same_drive(ours: Session, theirs: Session) -> bool:
    """Whether two records are of one drive; clock, longitude and zone may be set later."""
    return (ours.robot, ours.camera, ours.start_ns) == (
        theirs.robot,
        theirs.camera,
        theirs.start_ns,
    )
