"""A download taken into a robot's own map: the union of both by content, whole after any kill."""

from __future__ import annotations

import random
import shutil
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.builders import dies_before
from tests.maps.frames import CAMERA, FRONTEND
from tests.maps.maps import attempt, begin, edge, node, node_frame, session

from engram.errors import IncompatibleError, InputError, MapLockedError, RevisionError
from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.updating import update
from engram.frontend.frame import BRIEF
from engram.graph.model import (
    Amendable,
    Edge,
    EdgeKind,
    Omission,
    PathEntry,
    PathEntryKind,
    Session,
    path_id,
)
from engram.maps import writer
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.writer import RevisionWriter

DAY_NS = 86_400_000_000_000
REPLAYED_FROM = 2**32
WHOLE = DownloadOptions()
# An update of a small map makes about as many; a kill after the last finds it done.
_STATEMENTS = 300


@dataclass(frozen=True)
class Content:
    """What a map shows, as plain collections: the model of an update."""

    sessions: dict[Any, Session]
    amendments: set[Any]
    nodes: dict[Any, Any]
    edges: dict[Any, tuple[float, bytes]]
    entries: dict[Any, PathEntry]
    replayed: set[Any]
    attempts: Counter[Any]
    omissions: dict[Any, Any]

    @staticmethod
    def of(path: Path) -> Content:
        with Map.open(path) as store:
            found = store.load()
            hashes, made = store.landmark_hashes, found.attempts
            entries = found.path_entries
            own = [one for one in entries if one.kind is not PathEntryKind.REPLAYED]
            return Content(
                {one.id: one.as_recorded for one in found.sessions},
                set(store.amendments),
                {one.id: (one, hashes[one.id]) for one in found.nodes},
                {(e.a, e.b, e.kind): described(e) for e in found.edges},
                {(one.path, one.sequence): one for one in own},
                {(e.path, e.node, e.stamp_ns) for e in entries if e not in own},
                Counter(
                    (found.sessions[made.session[at]].id, *identity)
                    for at, identity in enumerate(
                        zip(
                            made.iteration.tolist(),
                            made.rank.tolist(),
                            made.sigma_m.tolist(),
                            made.accepted.tolist(),
                            made.inliers.tolist(),
                            strict=True,
                        )
                    )
                ),
                {one.omitted: one.node for one in store.omissions.values()},
            )


def described(one: Edge) -> tuple[float, bytes]:
    return float(np.trace(one.covariance[:3, :3])), one.a_from_b.matrix().tobytes()


def united(own: Content, fresh: Content, replaced: dict[Any, Any], centre: set[Any]) -> Content:
    """The model: what each has; the surer edge; own entries first; own omitted nodes tied."""
    edges = {
        key: min(own.edges.get(key, (np.inf, b"")), fresh.edges.get(key, (np.inf, b"")))
        for key in own.edges | fresh.edges
    }
    nodes = fresh.nodes | own.nodes
    for omitted, equivalent in replaced.items():
        if omitted in own.nodes and omitted not in centre and equivalent in nodes:
            edges.setdefault((equivalent, omitted, EdgeKind.MATCH), (0.12, b"tie"))
    return Content(
        fresh.sessions | own.sessions,
        fresh.amendments | own.amendments,
        nodes,
        edges,
        fresh.entries | own.entries,
        fresh.replayed | own.replayed,
        fresh.attempts | own.attempts,
        {
            omitted: equivalent
            for omitted, equivalent in (fresh.omissions | own.omissions).items()
            if omitted in own.omissions or omitted not in own.nodes
        },
    )


def without_ties(content: Content) -> Content:
    """Ties without their transform, which the omission gives."""
    edges = {
        key: (0.12, b"tie") if np.isclose(value[0], 0.12) else value
        for key, value in content.edges.items()
    }
    return replace(content, edges=edges)


class World:
    """A fleet map and one robot's map, changed step by step at random."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.rng = random.Random(seed)
        self.centre, self.robot = folder / "centre.engram", folder / "robot.engram"
        self.folder, self.count = folder, 0
        for path in (self.centre, self.robot):
            Map.create(path).close()
        self.drive(self.centre)
        self.drive(self.robot)

    def drive(self, path: Path) -> None:
        """One more session: saved nodes between matches with what the map has."""
        self.count += 1
        robot = "r1" if path == self.robot else f"other-{self.count}"
        drive = session(robot, self.count * DAY_NS + self.rng.randrange(20) * DAY_NS // 24)
        with Map.open(path, writes=True) as store:
            known = [one.id for one in store.load().nodes]
            with begin(store, drive) as writing:
                self._write_drive(writing, drive, known)
                writing.commit()

    def _write_drive(self, writing: RevisionWriter, drive: Session, known: list[Any]) -> None:
        saved: list[Any] = []
        for index in range(self.rng.randint(1, 4)):
            one = node(drive, index)
            writing.add_node(one, node_frame(drive, index, count=4))
            links = saved[-1:] + self.rng.sample(known, min(len(known), self.rng.randint(0, 2)))
            for at, other in enumerate(links):
                kind = EdgeKind.ODOMETRY if saved and not at else EdgeKind.MATCH
                writing.add_edge(edge(other, one.id, kind, seed=self.rng.randrange(99)))
            seen = self.rng.choice(known) if known and self.rng.random() < 0.5 else one.id
            kind = PathEntryKind.SAVED if seen == one.id else PathEntryKind.MATCHED
            path = path_id(drive.id)
            writing.add_path_entry(PathEntry(path, index, seen, kind, one.stamp_ns))
            writing.add_attempts(
                [attempt(index, seen, other, rank=at) for at, other in enumerate(links)]
            )
            saved.append(one.id)

    def hand_in(self) -> None:
        """The centre takes the robot's nodes or omits them, as a merge does."""
        with Map.open(self.robot) as robot, Map.open(self.centre, writes=True) as centre:
            theirs, held = robot.load(), centre.load()
            here = {one.id: one.id for one in held.nodes}
            here |= {one.omitted: one.node for one in centre.omissions.values()}
            taken = []
            with centre.begin_revision(author="t", message="", configuration={}) as writing:
                for one in theirs.sessions:
                    writing.add_session(one, CAMERA, descriptor=BRIEF, frontend=FRONTEND)
                for one in theirs.nodes:
                    if one.id in here:
                        continue
                    if held.nodes and self.rng.random() < 0.5:
                        here[one.id] = self.rng.choice(held.nodes).id
                        moved = edge(here[one.id], one.id, seed=self.count).a_from_b
                        writing.add_omission(Omission(one.id, here[one.id], moved))
                    else:
                        here[one.id] = one.id
                        taken.append(one)
                for stored in robot.frames.stored(taken):
                    writing.copy_node(stored)
                self._hand_in_links(writing, theirs, held, here)
                writing.commit()

    def _hand_in_links(self, writing: RevisionWriter, theirs: Any, held: Any, here: Any) -> None:
        known = {(e.a, e.b, e.kind) for e in held.edges}
        for one in theirs.edges:
            is_same = (here[one.a], here[one.b]) == (one.a, one.b)
            if is_same and (one.a, one.b, one.kind) not in known:
                surer = self.rng.choice((0.5, 1.0))
                writing.add_edge(Edge(one.a, one.b, one.kind, one.a_from_b, surer * one.covariance))
        had = {(e.path, e.sequence) for e in held.path_entries}
        replayed = {(e.path, e.node, e.stamp_ns) for e in held.path_entries}
        last: Counter[Any] = Counter()
        for one in (*held.path_entries, *theirs.path_entries):
            last[one.path] = max(last[one.path], one.sequence + 1)
        for one in theirs.path_entries:
            if (one.path, one.sequence) in had:
                continue
            kind, sequence = one.kind, one.sequence
            if here[one.node] != one.node:
                kind, sequence = PathEntryKind.REPLAYED, max(REPLAYED_FROM, last[one.path])
                last[one.path] = sequence + 1
                if (one.path, here[one.node], one.stamp_ns) in replayed:
                    continue
            writing.add_path_entry(
                PathEntry(one.path, sequence, here[one.node], kind, one.stamp_ns)
            )

    def amend(self) -> None:
        with Map.open(self.rng.choice((self.centre, self.robot)), writes=True) as store:
            if not store.sessions:  # all that was written is reverted
                return
            drive = self.rng.choice(list(store.sessions))
            store.amend(drive, {Amendable.ROBOT: f"name-{self.count}"}, author="t")
            self.count += 1

    def revert(self) -> None:
        with Map.open(self.centre, writes=True) as store:
            number = self.rng.randint(1, store.revision)
            kept = [one for one in store.log() if one.number != number]
            if len(kept) < 1 or store.node_count() < 3:
                return
            with suppress(RevisionError):  # nothing of it is visible any more
                store.revert(number, author="t")

    def options(self) -> DownloadOptions:
        with Map.open(self.centre) as store:
            found = store.load()
        policy = self.rng.choice(("copy", "copy", "region", "tod", "route"))
        if policy == "region":
            near = (str(self.rng.choice(found.nodes).id),)
            return DownloadOptions("region", near=near, radius_m=2.0)
        if policy == "tod":
            return DownloadOptions("tod", depart_h=self.rng.uniform(0, 23.9), window_min=720.0)
        if policy == "route":
            driven = {one.path for one in found.path_entries}
            drives = [one.id for one in found.sessions if path_id(one.id) in driven]
            return DownloadOptions("route", route=str(self.rng.choice(drives)), radius_m=1.0)
        return WHOLE

    def step(self) -> None:
        acts = (self.hand_in, self.amend, self.revert)
        drives = (lambda: self.drive(self.centre), lambda: self.drive(self.robot))
        self.rng.choice((*drives, *drives, self.hand_in, *acts))()

    def nodes(self) -> int:
        with Map.open(self.centre) as store:
            return store.node_count()


def check_update(
    world: World, options: DownloadOptions, *, again: bool, killed: Content | None = None
) -> None:
    """One update against the model; if asked, also that a second one changes nothing.

    What a kill left is the map before or after.
    """
    fresh_file = world.folder / f"fresh-{world.count}-{random.random()}.engram"
    download(world.centre, fresh_file, options)
    before, fresh = Content.of(world.robot), Content.of(fresh_file)
    with Map.open(world.centre) as store:
        replaced = {one.omitted: one.node for one in store.omissions.values()}
        held = {one.id for one in store.load().nodes}
    with Map.open(world.robot) as store:
        history = [(one.number, one.message) for one in store.log()]
    report = update(world.centre, world.robot, options)
    after = Content.of(world.robot)
    assert killed is None or killed in (before, after)
    assert without_ties(after) == without_ties(united(before, fresh, replaced, held))
    assert report.nodes == len(fresh.nodes.keys() - before.nodes.keys())
    assert report.own_nodes == len(before.nodes.keys() - fresh.nodes.keys())
    with Map.open(world.robot) as store:
        assert [(one.number, one.message) for one in store.log()][: len(history)] == history
    fresh_file.unlink()
    if again:
        assert update(world.centre, world.robot, options).revision is None
        assert Content.of(world.robot) == after
        assert check_file(world.robot).problems == ()


def run_history(folder: Path, seed: int, rounds: int, *, killed: bool = False) -> None:
    world = World(folder, seed)
    for _ in range(rounds):
        for _ in range(world.rng.randint(1, 3)):
            world.step()
        if world.nodes():
            options = world.options()
            at = random.Random(seed).randrange(_STATEMENTS)
            left = left_by_kill(world, options, at) if killed else None
            check_update(world, options, again=rounds > 1, killed=left)


def left_by_kill(world: World, options: DownloadOptions, statement: int) -> Content:
    """What a kill leaves of a copy of the robot's map."""
    copy = world.folder / "killed.engram"
    shutil.copy(world.robot, copy)
    killed_at(statement, world.centre, copy, options)
    assert check_file(copy).problems == ()
    found = Content.of(copy)
    for left in world.folder.glob("killed*"):
        left.unlink()
    return found


@pytest.mark.parametrize(
    ("first", "end"),
    [
        (1, 4),
        *(pytest.param(*ends, marks=pytest.mark.long) for ends in ((0, 1), (4, 17), (17, 30))),
    ],
)
def test_updated_equals_fresh_united_with_own(tmp_path, first, end):
    for seed in range(first, end):
        (tmp_path / str(seed)).mkdir()
        run_history(tmp_path / str(seed), seed, rounds=1 + (seed % 5 == 0))


def test_own_nodes_are_tied_to_equivalents_that_an_earlier_update_brought(tmp_path):
    run_history(tmp_path, 1047, rounds=2)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
@pytest.mark.parametrize("first", range(1000, 2000, 20))
def test_updated_equals_fresh_united_with_own_in_a_thousand_histories(tmp_path, first):
    """In parts of twenty, so that a run goes on by `-k "thousand and 1340"`."""
    for seed in range(first, first + 20):
        folder = tmp_path / str(seed)
        folder.mkdir()
        run_history(folder, seed, rounds=1 + (seed % 5 == 0), killed=True)
        shutil.rmtree(folder)


def test_a_file_that_was_downloaded_is_a_source_too(tmp_path):
    world = World(tmp_path, 3)
    options = DownloadOptions("tod", depart_h=12.0, window_min=720.0)
    one, other = tmp_path / "one.engram", tmp_path / "file.engram"
    shutil.copy(world.robot, one)
    download(world.centre, other, options)
    update(world.centre, world.robot, options)
    update(other, one)
    assert Content.of(one) == Content.of(world.robot)


def killed_at(statement: int, centre: Path, robot: Path, options: DownloadOptions = WHOLE) -> bool:
    """Runs an update in a child that dies before its n-th statement; whether it died."""

    def work() -> None:
        writer._BATCH_BYTES = 2000  # several checkpoints
        update(centre, robot, options)

    return dies_before(statement, work)


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
@pytest.mark.parametrize("every", [120, pytest.param(1, marks=pytest.mark.long)])
def test_killed_anywhere_the_map_is_the_one_before_or_the_one_after(tmp_path, every):
    world = World(tmp_path, 1)
    for _ in range(3):
        world.drive(world.centre)
    before, after = Content.of(world.robot), None
    done = tmp_path / "done.engram"
    shutil.copy(world.robot, done)
    update(world.centre, done)
    after = Content.of(done)
    found = set()
    statement, died = 0, True
    while died:
        robot = tmp_path / "killed.engram"
        for left in tmp_path.glob("killed*"):
            left.unlink()
        shutil.copy(world.robot, robot)
        died = killed_at(statement, world.centre, robot)
        content = Content.of(robot)
        assert content in (before, after)
        assert check_file(robot).problems == ()
        found.add(content == after)
        update(world.centre, robot)
        assert Content.of(robot) == after
        statement += every
    assert found == {False, True}


def test_nodes_that_the_robot_reverted_come_back_with_their_links(tmp_path):
    world = World(tmp_path, 5)
    report = update(world.centre, world.robot)
    with_all = Content.of(world.robot)
    with Map.open(world.robot, writes=True) as store:
        store.revert(report.revision, author="t")
    assert len(Content.of(world.robot).nodes) < len(with_all.nodes)
    update(world.centre, world.robot)
    assert Content.of(world.robot) == with_all


def test_contradictions_are_refused_before_anything_is_written(tmp_path):
    world = World(tmp_path, 7)
    with Map.open(world.centre) as store:
        theirs = next(iter(store.sessions.values())).as_recorded
        stolen = next(iter(store.load().nodes))
    with Map.open(world.robot, writes=True) as store, begin(store, theirs) as writing:
        other = replace(node_frame(theirs, 77, count=4), stamp_ns=stolen.stamp_ns)
        writing.add_node(stolen, other)
        writing.commit()
    before = Content.of(world.robot)
    with pytest.raises(IncompatibleError, match="a node never changes"):
        update(world.centre, world.robot)
    assert Content.of(world.robot) == before


def test_the_fleet_map_itself_and_a_locked_map_are_refused(tmp_path):
    world = World(tmp_path, 9)
    with pytest.raises(InputError, match="is the fleet map itself"):
        update(world.centre, world.centre)
    with Map.open(world.robot, writes=True), pytest.raises(MapLockedError):
        update(world.centre, world.robot)
