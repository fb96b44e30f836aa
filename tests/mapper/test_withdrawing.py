"""A fix that a later one contradicts leaves no trace; a doubtful one joins nothing."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
import pytest
from tests.builders import Mapped, Seen, World, drive, session_for

from engram.frontend.frame import Frame
from engram.frontend.matching import NO_MATCH, Match
from engram.geometry.se3 import SE3
from engram.graph.model import Attempt, NodeId, PathEntry, PathEntryKind, Session, path_id
from engram.localiser.acceptance import Prediction, Spread
from engram.localiser.attempts import Lanes, one_by_one
from engram.localiser.localisation import Position
from engram.localiser.localiser import Localiser
from engram.mapper.mapper import Mapper, Memory, Records, Saver
from engram.maps.map import Map
from engram.maps.writer import RevisionWriter
from engram.robot.drive_session import RevisionSink
from engram.robot.front import Front
from engram.robot.localisers import localiser_in
from engram.robot.robot import Robot
from engram.robot.settings import Settings
from engram.robot.starting import summarise
from engram.testing.contracts import make_node
from engram.viewing.trajectory import chain_trajectory

ROAD = World(length_m=120.0, seed=11)
ELSEWHERE = World(length_m=60.0, seed=12)
MIRAGE = 10


class Mirage:
    """Matches as usual, but for some frames only a look-alike, with few inliers."""

    matches = one_by_one

    def __init__(self, opened: Map, node: NodeId, stamps_ns: set[int]) -> None:
        self._usual = Lanes(opened.frames, Settings().localiser.matcher)
        self._node, self._stamps_ns = node, stamps_ns

    def match(self, live: Frame, live_id: NodeId, node: NodeId, guide: Prediction | None) -> Match:
        if live.stamp_ns not in self._stamps_ns:
            return self._usual.match(live, live_id, node, guide)
        if node != self._node:
            return NO_MATCH
        rows = np.arange(24, dtype=np.int32)
        return Match(SE3.identity(), 1e-3 * np.eye(6), 24, rows, rows)

    def spread(self, live: Frame, live_id: NodeId, node: NodeId, match: Match) -> Spread:
        return self._usual.spread(live, live_id, node, match)

    def prefetch(self, nodes: list[NodeId]) -> None:
        self._usual.prefetch(nodes)


class Notes:
    """What a saver writes."""

    def __init__(self) -> None:
        self.entries: list[PathEntry] = []
        self.attempts: list[Attempt] = []

    def add(self, records: Records, entry: PathEntry | None) -> None:
        self.entries += [] if entry is None else [entry]
        self.attempts += records.attempts

    def checkpoint(self) -> None:
        """Nothing to do."""


@pytest.fixture
def town(mapped: tuple[Path, Mapped], tmp_path: Path) -> Path:
    return Path(shutil.copy(mapped[0], tmp_path))


@contextmanager
def misled(
    path: Path, live: list[Seen], *, saves: bool
) -> Iterator[tuple[Map, Localiser, RevisionWriter | None]]:
    """A robot that is told a wrong node, and that sees a look-alike there at first."""
    with Map.open(path, writes=saves) as opened, opened.writing() if saves else nullcontext():
        node = sorted(opened.graph.nodes, key=lambda one: one.stamp_ns)[MIRAGE].id
        session = session_for(live, "misled")
        writer = _begun(opened, session, live[0].frame) if saves else None
        matcher = Mirage(opened, node, {live[0].frame.stamp_ns})
        with localiser_in(
            opened,
            live[0].frame.camera,
            Settings(),
            policy="distance",
            live=session.id,
            saves=saves,
            matcher=matcher,
        ) as localiser:
            localiser.place_at(Position(node, SE3.identity(), 1e-2 * np.eye(6)))
            yield opened, localiser, writer


def _begun(opened: Map, session: Session, first: Frame) -> RevisionWriter:
    return opened.begin_session(
        session,
        first.camera,
        descriptor=first.descriptor,
        frontend=first.frontend,
        author="misled",
        configuration={},
    )


def test_a_fix_that_a_later_one_contradicts_is_withdrawn_and_forgotten(town: Path) -> None:
    live = drive(ROAD, np.arange(50, 75, 1.0), start_ns=3_000_000_000_000, seed=2)
    notes = Notes()
    with misled(town, live, saves=False) as (_, localiser, _):
        memory = Memory(localiser, Saver(notes, path_id(localiser.live)))
        robot = Robot(Front(Settings()), localiser, memory)
        found = [robot.step(seen.logged) for seen in live]
        memory.finish()
        memory._saver.finish()
        false = found[0].node
    assert found[0].localised
    assert found[0].inliers == 24
    again = next(one for one in found[1:] if one.localised)
    assert again.withdraws == (found[0].stamp_ns,)
    rested = found[: found.index(again)]
    assert len(rested) > 1
    assert {robot.pose_at(one.stamp_ns) for one in rested} == {None}
    assert robot.pose_at(again.stamp_ns) is again.position
    stamp_ns, first_from_live = chain_trajectory(localiser.graph, found)[0]
    assert stamp_ns == again.stamp_ns
    assert first_from_live.distance_m == pytest.approx(again.node_from_live.distance_m)
    assert summarise(found)["withdrawn"] == 1
    assert notes.entries
    assert false not in {entry.node for entry in notes.entries}
    assert [entry.sequence for entry in notes.entries] == list(range(len(notes.entries)))
    assert not any(one.accepted and one.node == false for one in notes.attempts)


def test_a_mapping_robot_joins_nothing_by_a_fix_that_nothing_confirms(town: Path) -> None:
    live = drive(ELSEWHERE, np.arange(0, 30, 1.0), start_ns=4_000_000_000_000, seed=2)
    with misled(town, live, saves=True) as (opened, localiser, writer):
        assert writer is not None
        session = writer.session
        sink = RevisionSink(writer, opened.frames, None, Settings().placing)
        saver = Saver(sink, path_id(session.id))
        mapper = Mapper(localiser.graph, localiser, saver, session)
        robot = Robot(Front(Settings()), localiser, mapper)
        found = [robot.step(seen.logged) for seen in live]
        mapper.finish()
        saver.finish()
        graph = localiser.graph
        own = graph.sessions == graph.session_number(session.id)
        labels = graph.components()
    assert found[0].localised
    assert found[0].saved is not None  # it matched weakly
    assert sum(one.saved is not None for one in found) > 15
    assert not set(labels[own]) & set(labels[~own])
    assert len(set(labels[own])) == 1


def test_a_saved_node_is_visited_though_its_match_is_withdrawn() -> None:
    notes, saved, matched = Notes(), make_node(0, 1), make_node(1, 0)
    saver = Saver(notes, path_id(saved.session))
    saver.put(Records(0, visit=(matched.id, PathEntryKind.MATCHED)), held_back=2)
    saver.put(Records(1, node=saved, visit=(saved.id, PathEntryKind.SAVED)), held_back=2)
    saver.withdraw(0)
    saver.withdraw(1)
    saver.put(Records())
    saver.finish()
    assert [entry.node for entry in notes.entries] == [saved.id]
