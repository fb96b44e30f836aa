"""Adding, checkpointing, committing, abandoning, crashing in any order, against a plain model."""

from __future__ import annotations

import copy
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)

from engram.errors import RevisionError
from engram.graph.model import EdgeKind
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.records import SessionState
from engram.maps.writer import RevisionWriter

from .frames import assert_same_landmarks
from .maps import Drive, assert_same_edges, begin, edge, session

ROBOTS = [f"robot-{number}" for number in range(4)]


class MapMachine(RuleBasedStateMachine):
    """The model: a list of committed drives, the interrupted ones, and the one being written.

    A drive in the model is a `Drive`; what was added since its last checkpoint is in `writing`
    and not yet in `durable`. Proximity edges that supersede each other are kept apart, by key.
    """

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.location = Path(self.folder.name) / "town.engram"
        self.committed: list[tuple[Drive, dict]] = []
        self.interrupted: dict[str, tuple[Drive, dict]] = {}
        self.writing: tuple[Drive, dict] | None = None
        self.durable: tuple[Drive, dict] | None = None
        self.writer: RevisionWriter | None = None
        self.seed = 0

    @initialize()
    def create(self) -> None:
        self.store: Map = Map.create(self.location)

    @precondition(lambda self: self.writer is None)
    @rule(robot=st.sampled_from(ROBOTS))
    def begin(self, robot: str) -> None:
        drive = session(robot)
        known = any(one.session == drive for one, _ in self.committed)
        if known or robot in self.interrupted:
            with pytest.raises(RevisionError):
                begin(self.store, drive)
            return
        self.writer = begin(self.store, drive)
        self.writing = (Drive(drive), {})
        self.durable = copy.deepcopy(self.writing)

    @precondition(lambda self: self.writer is not None)
    @rule(count=st.integers(1, 3))
    def add_nodes(self, count: int) -> None:
        drive, _ = self.writing
        for _ in range(count):
            drive.write_node(self.writer, len(drive.nodes))
        last = drive.nodes[-1].id
        assert_same_landmarks(self.store.frames.frame(last).landmarks, drive.frames[last].landmarks)

    @precondition(lambda self: self.writer is not None and len(self.writing[0].nodes) > 1)
    @rule(data=st.data())
    def add_superseding_edge(self, data: st.DataObject) -> None:
        """Between any two nodes that are seen, those of older revisions too."""
        proximity = self.writing[1]
        seen = [node.id for one, _ in [*self.committed, self.writing] for node in one.nodes]
        a = data.draw(st.sampled_from(seen[:2]))
        b = data.draw(st.sampled_from([one for one in seen[-2:] if one != a]))
        self.seed += 1
        added = edge(a, b, EdgeKind.PROXIMITY, self.seed)
        self.writer.add_edge(added)
        proximity[a, b] = added

    @precondition(lambda self: self.writer is not None)
    @rule()
    def checkpoint(self) -> None:
        self.writer.checkpoint()
        self.durable = copy.deepcopy(self.writing)

    @precondition(lambda self: self.writer is not None)
    @rule()
    def commit(self) -> None:
        revision = self.writer.commit()
        self.committed.append(self.writing)
        assert revision.number == len(self.committed)
        assert revision.contents["nodes"] == len(self.writing[0].nodes)
        self.writer = self.writing = self.durable = None

    @precondition(lambda self: self.writer is not None)
    @rule()
    def abandon(self) -> None:
        self.writer.abandon()
        self.writer = self.writing = self.durable = None

    @rule()
    def crash(self) -> None:
        """All that is left is the file."""
        self.store.close()
        if self.writer is not None:
            self.interrupted[self.writer.session.robot] = self.durable
        self.writer = self.writing = self.durable = None
        self.store = Map.open(self.location, writes=True)

    @precondition(lambda self: self.writer is None and self.interrupted)
    @rule(data=st.data(), seal=st.booleans())
    def resume_or_seal(self, data: st.DataObject, seal: bool) -> None:
        robot = data.draw(st.sampled_from(sorted(self.interrupted)))
        left = self.interrupted.pop(robot)
        if seal:
            self.store.seal(left[0].session.id)
            self.committed.append(left)
            return
        self.writer = self.store.resume_session(left[0].session.id)
        assert self.writer.stored.nodes == tuple(left[0].nodes)
        assert self.writer.stored.next_sequence == len(left[0].entries)
        self.writing, self.durable = left, copy.deepcopy(left)

    @precondition(lambda self: self.writer is None)
    @rule()
    def clean(self) -> None:
        self.store.clean()

    @rule(data=st.data())
    def read_at(self, data: st.DataObject) -> None:
        at = data.draw(st.integers(0, len(self.committed)))
        with Map.open(self.location, at=at) as store:
            contents = store.load()
            drives = self.committed[:at]
            assert contents.sessions == tuple(one.session for one, _ in drives)
            assert contents.nodes == tuple(node for one, _ in drives for node in one.nodes)
            assert contents.path_entries == tuple(e for one, _ in drives for e in one.entries)
            odometry = [e for e in contents.edges if e.kind is EdgeKind.ODOMETRY]
            assert_same_edges(odometry, [e for one, _ in drives for e in one.edges])
            newest = {key: e for _, edges in drives for key, e in edges.items()}
            proximity = {(e.a, e.b): e for e in contents.edges if e.kind is EdgeKind.PROXIMITY}
            assert proximity.keys() == newest.keys()
            assert len(contents.edges) == len(odometry) + len(proximity)
            for key, found in proximity.items():
                assert_same_edges([found], [newest[key]])
            assert len(contents.attempts) == sum(len(one.attempts) for one, _ in drives)
            for one, _ in drives:
                for node, frame in one.frames.items():
                    assert_same_landmarks(store.frames.frame(node).landmarks, frame.landmarks)

    @rule()
    def check(self) -> None:
        report = check_file(self.location)
        assert report.problems == ()
        assert len(report.interrupted) == len(self.interrupted)

    @invariant()
    def history_is_as_long_as_the_model(self) -> None:
        if not hasattr(self, "store"):
            return
        with Map.open(self.location) as reader:
            assert reader.revision == len(self.committed)
            assert {one.session.robot for one in reader.interrupted()} == self.interrupted.keys()
            for robot in ROBOTS:
                assert reader.session_state(session(robot).id) is self._state(robot)

    def _state(self, robot: str) -> SessionState:
        if any(one.session.robot == robot for one, _ in self.committed):
            return SessionState.COMMITTED
        if robot in self.interrupted:
            return SessionState.INTERRUPTED
        writing = self.writer is not None and self.writer.session.robot == robot
        return SessionState.OPEN if writing else SessionState.ABSENT

    def teardown(self) -> None:
        if hasattr(self, "store"):
            self.store.close()
        self.folder.cleanup()


TestFileMachine = MapMachine.TestCase
TestFileMachine.settings = settings(
    max_examples=8, stateful_step_count=20, suppress_health_check=list(HealthCheck)
)
