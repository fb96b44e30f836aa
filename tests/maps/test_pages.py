"""A map that is read by pages says what the whole one says, to the bit."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest

from engram.errors import MapCorruptError
from engram.frontend.frame import BRIEF
from engram.geometry.se3 import SE3
from engram.graph import paths as path_memories
from engram.graph.basin import MatchBasin, count_attempts
from engram.graph.graph import ExperienceGraph
from engram.graph.model import (
    Edge,
    EdgeKind,
    Goal,
    Node,
    NodeId,
    PathEntry,
    PathEntryKind,
    Removal,
    path_id,
)
from engram.graph.neighbourhood import Search
from engram.graph.pages import PagedGraph
from engram.graph.paths import Attempts, PathMemory
from engram.localiser.settings import LocaliserConfig
from engram.maps.map import Map
from engram.maps.map_frame import moves
from engram.maps.writer import RevisionWriter
from engram.ranking.lessons import Lessons
from engram.robot.localisers import lessons_of

from .frames import CAMERA, FRONTEND, frame
from .maps import assert_same_edges, attempt, node, session

_SIGMA = np.diag([0.05**2] * 3 + [0.01**2] * 3)
_VAGUE = 400 * _SIGMA
LENGTH = 90  # of a drive: more than a page, and no multiple of it


def _edge(a: Node, b: Node, kind: EdgeKind, rng: np.random.Generator) -> Edge:
    metres = b.driven_m - a.driven_m
    pose = SE3.exp([0.05 * rng.normal(), 0.0, metres, 0.0, 0.02 * rng.normal(), 0.0])
    return Edge(a.id, b.id, kind, pose, _VAGUE if rng.random() < 0.05 else _SIGMA)


class _Town:
    """Drives along one street, with what past drives leave: edges, paths and attempts."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)
        self.nodes: list[Node] = []

    def drive(self, writer: RevisionWriter, name: str, *, silent: bool = False) -> None:
        rng, made = self.rng, session(name, 10**12 + len(self.nodes) * 10**9)
        writer.add_session(made, CAMERA, descriptor=BRIEF, frontend=FRONTEND)
        known, own = list(self.nodes), list[Node]()
        for index in range(LENGTH):
            one = node(made, index)
            writer.add_node(one, frame(one.stamp_ns, count=4, seed=index))
            if own and index != 40:  # a gap of odometry
                writer.add_edge(_edge(own[-1], one, EdgeKind.ODOMETRY, rng))
            near = [other for other in known if abs(other.driven_m - one.driven_m) < 4]
            picked = [near[at] for at in rng.permutation(len(near))[:4]]
            for other in picked:
                writer.add_edge(_edge(other, one, rng.choice(list(_CROSS)), rng))
            visits = [(one, PathEntryKind.SAVED), *((o, PathEntryKind.MATCHED) for o in picked[:2])]
            for at, (visited, kind) in enumerate(visits):
                place = 3 * index + at
                writer.add_path_entry(
                    PathEntry(path_id(made.id), place, visited.id, kind, one.stamp_ns)
                )
            if not silent and own:
                tried = [
                    attempt(
                        index,
                        own[-1].id,
                        other.id,
                        along_m=float(rng.normal()),
                        accepted=bool(rng.random() < 0.6),
                        rank=rank,
                    )
                    for rank, other in enumerate([own[-1], *picked])
                ]
                writer.copy_attempts(made.id, *Attempts.of(tried))
            own.append(one)
        self.nodes += own

    def supersede(self, writer: RevisionWriter, edges: list[Edge]) -> None:
        for one in edges:
            ends = {end.id: end for end in self.nodes}
            writer.add_edge(_edge(ends[one.a], ends[one.b], one.kind, self.rng))


_CROSS = (EdgeKind.MATCH, EdgeKind.PROXIMITY)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Revisions: 1 two drives, 2 a third, 3 newer edges and a removal, 4 a fourth, 5 reverts 2."""
    path, made = tmp_path_factory.mktemp("town") / "town.engram", _Town()
    with Map.create(path) as opened:
        with opened.begin_revision(author="a", message="", configuration={}) as writer:
            made.drive(writer, "one")
            made.drive(writer, "two", silent=True)
            writer.commit()
        with opened.begin_revision(author="a", message="", configuration={}) as writer:
            made.drive(writer, "three")
            writer.commit()
        opened.forget()
        edges = [one for one in opened.graph.edges if one.kind is not EdgeKind.ODOMETRY]
        with opened.begin_revision(author="a", message="", configuration={}) as writer:
            made.supersede(writer, edges[5:100:9])
            gone = edges[7]
            writer.add_mark(Removal(gone.a, gone.b, gone.kind, gone.a_from_b, "wrong", 5))
            writer.commit()
        with opened.begin_revision(author="a", message="", configuration={}) as writer:
            made.drive(writer, "four")
            writer.commit()
        opened.revert(2, author="a")
    return path


@pytest.fixture(scope="module", params=[1, 3, 4, None])
def opened(town: Path, request: pytest.FixtureRequest) -> Iterator[Map]:
    with Map.open(town, at=request.param) as found:
        yield found


def _ids(graph: ExperienceGraph, nodes: np.ndarray) -> list[object]:
    return [graph.node(index).id for index in nodes.tolist()]


@pytest.mark.parametrize("budget_bytes", [0, 10**9])
def test_searches_find_the_same(opened: Map, budget_bytes: int) -> None:
    whole, paged = opened.graph, PagedGraph(opened.pages, budget_bytes)
    rng = np.random.default_rng(1)
    for number in rng.permutation(len(whole))[:120].tolist():
        one = whole.node(number)
        index = paged.index(one.id)
        assert paged.node(index) == one
        live = SE3.exp(0.3 * rng.normal(size=6) * [1, 0, 1, 0, 1, 0])
        search = Search(float(rng.uniform(3, 12)), 0.8)
        covariance = rng.choice([1.0, 100.0]) * _SIGMA
        paged.trim()
        ours = paged.neighbourhood(index, live, covariance, search)
        theirs = whole.neighbourhood(number, live, covariance, search)
        assert _ids(paged, ours.nodes) == _ids(whole, theirs.nodes)
        for name in ("node_from_live", "sigma_m", "sigma_yaw_rad", "pivot_in_node", "yaw_rad"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
        np.testing.assert_array_equal(
            paged.uuid_words_of(ours.nodes), whole.uuid_words_of(theirs.nodes)
        )
        assert [paged.session(n) for n in paged.sessions_of(ours.nodes).tolist()] == [
            whole.session(n) for n in whole.sessions_of(theirs.nodes).tolist()
        ]


def test_questions_about_nodes_have_the_same_answers(opened: Map) -> None:
    whole, paged = opened.graph, PagedGraph(opened.pages, 0)
    indices = {index: node for index, node in enumerate(paged.ids(0)) if node is not None}
    assert list(indices.values()) == [one.id for one in whole.nodes]
    for number, (index, one) in enumerate(indices.items()):
        paged.trim()
        ours, theirs = paged.edges_of(index), whole.edges_of(number)
        assert [(e.a, e.b, e.kind) for e in ours] == [(e.a, e.b, e.kind) for e in theirs]
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a.covariance, b.covariance)
        odometry = [(e.a, e.b) for e in theirs if e.kind is EdgeKind.ODOMETRY]
        assert [(e.a, e.b) for e in paged.edges_of(index, EdgeKind.ODOMETRY)] == odometry
        other = list(indices)[(7 * number) % len(indices)]
        known, expected = (
            graph.predict(graph.index(one), graph.index(indices[other])) for graph in (paged, whole)
        )
        assert (known is None) == (expected is None)
        if known is not None and expected is not None:
            np.testing.assert_array_equal(known[0].matrix(), expected[0].matrix())
            np.testing.assert_array_equal(known[1], expected[1])
    some = np.array(list(indices)[::7], np.int64)
    numbers = np.array([whole.index(indices[index]) for index in some.tolist()], np.int64)
    ours, theirs = (
        graph.half_edges_from(nodes, 3.0)
        for graph, nodes in ((PagedGraph(opened.pages, 0), some), (whole, numbers))
    )
    assert len(ours.sources) > len(some)
    pairs = [
        sorted(zip(_ids(graph, half.sources), _ids(graph, half.targets), strict=True))
        for graph, half in ((paged, ours), (whole, theirs))
    ]
    assert pairs[0] == pairs[1]
    ours, theirs = paged.half_edges(3.0), whole.half_edges(3.0)
    pairs = [
        sorted(zip(_ids(graph, half.sources), _ids(graph, half.targets), strict=True))
        for graph, half in ((paged, ours), (whole, theirs))
    ]
    assert pairs[0] == pairs[1]


def test_hidden_nodes_are_not_there(town: Path) -> None:
    with Map.open(town, at=4) as before, Map.open(town) as after:
        paged = after.read_graph()
        hidden = [one for one in before.graph.nodes if one.id not in after.graph]
        assert len(hidden) == LENGTH
        assert not any(one.id in paged for one in hidden)
        gaps = [index for index, one in enumerate(paged.ids(0)) if one is None]
        assert len(gaps) == LENGTH
        assert not any(map(paged.holds, gaps))


def test_lessons_basin_and_paths_are_the_same(opened: Map) -> None:
    paged, whole, config = opened.read_graph(), opened.graph, LocaliserConfig()
    basin, lessons = lessons_of(opened, CAMERA.fx, config.basin, config.lessons)
    made, viewers = opened.attempts, [path_id(one) for one in opened.sessions]
    counts = count_attempts(
        made.session.astype(np.int64),
        whole.experiences[made.node].astype(np.int64),
        made.iteration,
        (made.along_m.astype(np.float64), made.across_m.astype(np.float64)),
        made.sigma_m.astype(np.float64),
        made.accepted,
    )
    assert counts.attempts.sum() > 0
    counted = MatchBasin.of(CAMERA.fx, counts, config.basin)
    np.testing.assert_array_equal(basin.rates, counted.rates)
    rates = counted.success_rate(made.along_m.astype(np.float64), made.across_m.astype(np.float64))
    learnt = Lessons.learnt(whole, opened.path_memory, viewers, made, rates, config.lessons)
    numbers = np.arange(len(whole), dtype=np.int32)
    nodes = np.array([paged.index(one.id) for one in whole.nodes], np.int32)
    np.testing.assert_array_equal(lessons.log_odds_of(nodes), learnt.log_odds_of(numbers))
    all_paths = PathMemory(paged, pages=opened.pages)
    for kinds in ({PathEntryKind.MATCHED}, set(PathEntryKind)):
        paths, known = all_paths.counting(kinds), opened.path_memory.counting(kinds)
        for some in (slice(0, 70), slice(-90, None)):
            np.testing.assert_array_equal(
                paths.co_occurrence(nodes[some], nodes), known.co_occurrence(numbers[some], numbers)
            )
        seen = slice(20, 30)
        outcomes = np.arange(10) % 2 == 0
        np.testing.assert_array_equal(
            paths.scores(nodes, paths.evidence(nodes[seen], outcomes, int(nodes[3]))),
            known.scores(numbers, known.evidence(numbers[seen], outcomes, int(numbers[3]))),
        )


def test_what_is_added_stays(town: Path) -> None:
    rng = np.random.default_rng(3)
    with Map.open(town, at=4) as opened:
        whole, paged = opened.graph, PagedGraph(opened.pages, 0)
        made = session("new", 5)
        known = [whole.node(index) for index in (3, 70, 200)]
        new = [node(made, index) for index in range(5)]
        edges = [_edge(a, b, EdgeKind.ODOMETRY, rng) for a, b in pairwise(new)]
        edges += [_edge(a, b, EdgeKind.MATCH, rng) for a, b in zip(known, new, strict=False)]
        edges.append(next(_changed(one) for one in whole.edges if one.a == known[0].id))
        for graph in (whole, paged):
            for one in new:
                graph.add_node(one)
            graph.add_edges(edges)
        for _ in range(3):
            for one in (*known, *new):
                ours, theirs = (
                    graph.neighbourhood(graph.index(one.id), SE3.identity(), _SIGMA, Search(9, 3.0))
                    for graph in (paged, whole)
                )
                assert _ids(paged, ours.nodes) == _ids(whole, theirs.nodes)
                np.testing.assert_array_equal(ours.node_from_live, theirs.node_from_live)
                paged.trim()
        assert paged.find_edge(edges[-1].a, edges[-1].b, edges[-1].kind) is not None
        assert [paged.node(paged.index(one.id)) for one in new] == new
        memory = PathMemory(paged, pages=opened.pages)
        memory.add(PathEntry(path_id(made.id), 0, new[0].id, PathEntryKind.SAVED, 1))
        assert memory.on_paths(
            [path_id(made.id)], np.array([0, len(paged) - 5], np.int32)
        ).tolist() == [[False, True]]


def test_paths_that_were_dropped_are_read_again(
    town: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(path_memories, "_MOST_BYTES", 0)
    made = session("new", 5)
    with Map.open(town, at=4) as opened:
        graph = opened.read_graph()
        dropped, kept = (PathMemory(graph, pages=opened.pages) for _ in range(2))
        nodes = np.array([graph.index(one) for one in opened.graph.ids(0, 300) if one], np.int32)
        for memory in (dropped, kept):
            memory.add(
                PathEntry(path_id(made.id), 0, graph.node(int(nodes[5])).id, PathEntryKind.SAVED, 1)
            )
        for some in (slice(0, 70), slice(100, 200), slice(0, 70)):
            dropped.trim()
            np.testing.assert_array_equal(
                dropped.co_occurrence(nodes[some], nodes[::3]),
                kept.co_occurrence(nodes[some], nodes[::3]),
            )
        dropped.trim()
        assert dropped._bits.sum() > 0  # of the new entry alone
        assert dropped.on_paths([path_id(made.id)], nodes[4:7]).tolist() == [[False, True, False]]


def test_a_map_keeps_within_the_memory_that_it_is_given(town: Path) -> None:
    with Map.open(town) as opened:
        ids = [one.id for one in opened.graph.nodes[:50]]
        for one in ids:
            opened.frames.frame(one)
        held = opened.frames._cached_bytes
        opened.bound_memory(held)
        assert held / 2 < opened.frames._cached_bytes <= held * 5 / 6
        assert opened.read_graph()._budget_bytes == held // 6


def _changed(one: Edge) -> Edge:
    return Edge(one.a, one.b, one.kind, SE3(np.eye(3), np.array([0.0, 0.0, 0.5])), _SIGMA)


def test_lookups_find_what_the_whole_map_has(opened: Map) -> None:
    found, every = opened.load(), opened.lookups
    with Map.open(opened.location, at=4) as all_drives:
        some = [one.id for one in all_drives.load().nodes]
    held = every.nodes(some)
    assert [held[one.id].node for one in found.nodes] == list(found.nodes)
    assert len(held) == len(found.nodes)
    hashes = {one: there.landmark_hash for one, there in held.items()}
    assert hashes == opened.landmark_hashes == every.landmark_hashes(some)
    for path in opened.path_memory.paths:
        assert every.entries(path) == list(opened.path_memory.entries(path))
    picked = {one.id for one in found.nodes[10:20]}
    expected = [one for one in found.edges if picked & {one.a, one.b}]
    assert_same_edges(
        sorted(every.edges(picked), key=_key),
        sorted(expected, key=_key),
    )


def test_lookups_find_attempts_and_last_nodes_of_sessions(opened: Map) -> None:
    some = list(opened.sessions)
    made, keys = opened.attempts, {one.id: at for at, one in enumerate(opened.graph.nodes)}
    index = {there.key: keys[one] for one, there in opened.lookups.nodes(list(keys)).items()}
    ours = opened.lookups.attempts(some)
    order = np.argsort(made.session, kind="stable")
    for name in ("session", "iteration", "along_m", "accepted", "rank"):
        assert np.array_equal(getattr(ours, name), getattr(made, name)[order])
    for name in ("reference", "node"):
        assert [index[key] for key in getattr(ours, name).tolist()] == getattr(made, name)[
            order
        ].tolist()
    last = {one.session: one.stamp_ns for one in opened.graph.nodes}
    assert opened.lookups.last_stamps_ns() == last


def test_lookups_say_what_a_revision_moved(town: Path) -> None:
    with Map.open(town, at=1) as before, Map.open(town, at=3) as after:
        was, now = before.placements, after.placements
        goals = [Goal("dock", next(iter(was)), SE3.identity())]
        with Map.open(town, at=2) as between:
            known = between.placements
        assert after.lookups.moves(3, goals) == moves(known, now, goals)
        assert before.lookups.moves(1, []) == moves({}, was, [])


def _key(edge: Edge) -> tuple[object, object, EdgeKind]:
    return edge.a, edge.b, edge.kind


def test_sessions_of_nodes_are_known_without_their_pages(
    opened: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    paged = PagedGraph(opened.pages, 0)
    expected = {one.id: one.session for one in opened.graph.nodes}
    indices = {index: node for index, node in enumerate(paged.ids(0)) if node is not None}
    with monkeypatch.context() as patched:
        patched.setattr(PagedGraph, "_load_page", None)
        assert {node: paged.session_of(at) for at, node in indices.items()} == expected
    paged.node(next(iter(indices)))
    assert {node: paged.session_of(at) for at, node in indices.items()} == expected
    for unused in set(range(len(paged))) - set(indices):
        with pytest.raises(MapCorruptError):
            paged.session_of(unused)


def test_places_in_columns_are_those_of_the_records(opened: Map) -> None:
    placed = opened.placed()
    numbers = {one.number for one in opened.log()}
    assert set(placed.revision.tolist()) <= numbers
    found = dict(
        zip((uuid.tobytes() for uuid in placed.uuids), placed.positions.tolist(), strict=True)
    )
    expected = {node.bytes: pose.translation.tolist() for node, pose in opened.placements.items()}
    assert found == expected
    for uuid, number, stamp_ns in zip(
        placed.uuids, placed.session.tolist(), placed.stamp_ns.tolist(), strict=True
    ):
        record = opened.graph.node(opened.graph.index(NodeId(UUID(bytes=uuid.tobytes()))))
        assert (record.session, record.stamp_ns) == (placed.sessions[number].id, stamp_ns)


def test_parts_and_chains_in_columns_are_those_of_the_graph(opened: Map) -> None:
    placed, graph = opened.placed(), opened.graph
    at = [graph.index(NodeId(UUID(bytes=uuid.tobytes()))) for uuid in placed.uuids]
    assert len(np.unique(placed.experience)) > 1
    for found, expected in (
        (placed.component, graph.components()[at]),
        (placed.experience, graph.experiences[at]),
    ):
        pairs = set(zip(found.tolist(), expected.tolist(), strict=True))
        assert len(pairs) == len(set(found.tolist())) == len(set(expected.tolist()))


def test_a_goal_is_stored_in_the_nearest_node_that_looks_its_way(opened: Map) -> None:
    layout, rng = opened.layout(), np.random.default_rng(4)
    ahead = layout.poses.rotations[:, :2, 2]
    yaws_rad = np.arctan2(ahead[:, 1], ahead[:, 0])
    for _ in range(20):
        x_m, y_m, yaw_rad = rng.uniform([-400, -400, -3], [400, 400, 3])
        goal = opened.frame.goal(x_m, y_m, yaw_rad)
        turned = np.abs(np.angle(np.exp(1j * (yaws_rad - yaw_rad)))) > np.pi / 2
        away_m = np.hypot(*(layout.positions[:, :2] - (x_m, y_m)).T) + 5.0 * turned
        assert away_m[layout.graph.index(goal.node)] == away_m.min()
        here = opened.frame.locate(goal)
        assert (here.x_m, here.y_m) == pytest.approx((x_m, y_m), abs=1e-6)
        near = {node for node in opened.placements if opened.frame.find(node) is not None}
        assert goal.node in near
