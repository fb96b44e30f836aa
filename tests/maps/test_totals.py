"""What a revision counts on is what a reading of the whole map finds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from engram.graph.basin import BasinCounts, count_attempts
from engram.graph.model import EdgeKind, NodeId, PathEntry, PathEntryKind, Removal, path_id
from engram.graph.paths import Attempts
from engram.maps import counting, reading
from engram.maps.map import Map
from engram.maps.runs import Runs
from engram.maps.schema import nodes as nodes_table
from engram.maps.schema import runs as runs_table

from .maps import attempt, begin, edge, node, node_frame, session, write_drive


def compare(location: Path, at: int | None = None) -> None:
    """The stored totals with the records, read again."""
    with Map.open(location, at=at) as store:
        _compare(store)


def _compare(store: Map) -> None:
    found, contents, graph = store.totals(), store.load(), store.graph
    assert found.nodes == len(contents.nodes)
    assert found.sessions == len(contents.sessions)
    assert found.path_entries == len(contents.path_entries)
    assert sum(found.edges.values()) == len(contents.edges)
    assert found.attempts >= len(contents.attempts)  # those at hidden nodes count
    assert found.paths == len(store.path_memory)
    assert found.experiences == len(set(graph.experiences.tolist()))
    counts = np.bincount(graph.components()) if len(graph) else np.zeros(0, np.int64)
    assert (found.components, found.largest_component) == (len(counts), counts.max(initial=0))
    steps = [one.a_from_b for one in contents.edges if one.kind is EdgeKind.ODOMETRY]
    assert found.mapped_m == pytest.approx(sum(one.distance_m for one in steps))
    assert_counts(store, found.basin_counts)
    assert found.right_m == pytest.approx(
        max((pose.translation[0] for pose in store.placements.values()), default=None)
    )


def assert_counts(store: Map, counts: BasinCounts) -> None:
    """Compares the counts with those of all attempts at nodes that are there."""
    with store._database.reading() as connection:
        tables = reading.attempt_tables(connection, store._view)
        rows = list(store._view.rows(connection, nodes_table))
    experience_of = dict(zip((row["key"] for row in rows), store.graph.experiences, strict=True))
    made = Attempts.joined(list(tables.values()))
    drives = np.repeat(np.arange(len(tables)), [len(one) for one in tables.values()])
    here = np.isin(made.node, list(experience_of))
    made = made.rows(here)
    expected = count_attempts(
        drives[here],
        np.array([experience_of[key] for key in made.node.tolist()], np.int64),
        made.iteration,
        (made.along_m.astype(np.float64), made.across_m.astype(np.float64)),
        made.sigma_m.astype(np.float64),
        made.accepted,
    )
    np.testing.assert_array_equal(counts.attempts, expected.attempts)
    np.testing.assert_array_equal(counts.successes, expected.successes)


def test_they_agree_after_every_kind_of_revision(location: Path) -> None:
    with Map.create(location) as store:
        assert store.totals().nodes == 0
        with begin(store, session("robot-1")) as writer:
            first = write_drive(writer, 5)
            writer.add_edge(edge(first.nodes[0].id, first.nodes[4].id, EdgeKind.PROXIMITY, 1))
            writer.commit()
        compare(location)
        with begin(store, session("robot-2")) as writer:
            second = write_drive(writer, 4)
            writer.commit()
        compare(location)
        assert store.totals().components == 2
        with store.begin_revision(author="t", message="joined", configuration={}) as writer:
            writer.add_edge(edge(first.nodes[2].id, second.nodes[1].id, EdgeKind.MATCH, 2))
            writer.commit()
        compare(location)
        assert (store.totals().components, store.totals().experiences) == (1, 2)
        with store.begin_revision(author="t", message="again", configuration={}) as writer:
            writer.add_edge(edge(first.nodes[0].id, first.nodes[4].id, EdgeKind.PROXIMITY, 9))
            step = first.edges[1]
            writer.add_mark(Removal(step.a, step.b, step.kind, step.a_from_b, "a test", 5))
            writer.commit()
        compare(location)
        assert store.totals().edges["proximity"] == 1
        store.revert(2, author="t")
        compare(location)
        with begin(store, session("robot-2")) as writer:
            write_drive(writer, 4)
            writer.commit()
        compare(location)
    for at in range(1, 7):
        compare(location, at)


def test_attempts_count_with_those_of_earlier_revisions(location: Path) -> None:
    """A drive's attempt counts if it matched the experience shortly before."""
    with Map.create(location) as store:
        with begin(store, session("robot-1")) as writer:
            nodes = [one.id for one in write_drive(writer, 6).nodes]
            writer.commit()
        compare(location)
        before = store.totals().basin_counts.attempts.sum()

        def more(first: int, on: NodeId) -> None:
            made = [attempt(at, nodes[0], on, along_m=2.0) for at in range(first, first + 4)]
            with store.begin_revision(author="t", message="", configuration={}) as writer:
                writer.copy_attempts(session("robot-1").id, *Attempts.of(made))
                writer.commit()
            compare(location)

        more(6, nodes[5])
        more(9, nodes[2])
        assert store.totals().basin_counts.attempts.sum() >= before + 8
        with begin(store, session("robot-2")) as writer:
            others = [one.id for one in write_drive(writer, 4).nodes]
            writer.commit()
        more(14, others[3])
    for at in range(5):
        compare(location, at)


def test_attempts_count_again_where_experiences_join(location: Path) -> None:
    with Map.create(location) as store:
        with begin(store, session("robot-1")) as writer:
            nodes = [node(writer.session, index) for index in range(6)]
            for index, one in enumerate(nodes):
                writer.add_node(one, node_frame(writer.session, index))
                if index not in {0, 3}:
                    writer.add_edge(edge(nodes[index - 1].id, one.id, seed=index))
            path = path_id(writer.session.id)
            writer.add_path_entry(PathEntry(path, 0, nodes[0].id, PathEntryKind.SAVED, 0))
            tried = [
                attempt(at, nodes[0].id, nodes[0 if at % 4 else 5].id, accepted=at % 4 > 0)
                for at in range(20, 40)
            ]
            writer.add_attempts(tried)
            writer.commit()
        compare(location)
        apart = store.totals()
        assert apart.experiences == 2
        with store.begin_revision(author="t", message="joined", configuration={}) as writer:
            writer.add_edge(edge(nodes[2].id, nodes[3].id, EdgeKind.ODOMETRY, 1))
            writer.commit()
        compare(location)
        assert store.totals().experiences == 1
        joined = store.totals().basin_counts
        assert joined.attempts.sum() > apart.basin_counts.attempts.sum()


def test_a_commit_counts_its_own_rows_alone(location: Path, monkeypatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError("the whole map was counted")

    monkeypatch.setattr(counting, "count_all", never)
    with Map.create(location) as store:
        for name in ("robot-1", "robot-2"):
            with begin(store, session(name)) as writer:
                write_drive(writer, 4)
                writer.commit()
        assert store.totals().nodes == 8


def test_lost_runs_are_worked_out_again(location: Path) -> None:
    with Map.create(location) as store:
        with begin(store, session("robot-1")) as writer:
            write_drive(writer, 4)
            writer.commit()
        with store._database.writing() as connection:
            connection.execute(runs_table.delete())
        with begin(store, session("robot-2")) as writer:
            write_drive(writer, 3)
            writer.commit()
        compare(location)
        assert store.check().problems == ()


def test_runs_join_where_edges_do() -> None:
    keys = np.array([1, 2, 3, 7, 8, 9], np.int64)
    apart = Runs.of(keys)
    assert apart.find(np.array([0, 3, 5, 9])).tolist() == [-1, 2, -1, 5]
    chained = np.array([[1, 2], [2, 3], [7, 8]], np.int64)
    joined = apart.joined(chained, np.concatenate([chained, [[3, 9], [9, 8]]]))
    assert joined.first.tolist() == [1, 7, 9]
    assert joined.last.tolist() == [3, 8, 9]
    assert joined.experience.tolist() == [1, 7, 9]
    assert joined.component.tolist() == [1, 1, 1]
    assert joined.largest == 6
    grown = joined.with_nodes(np.array([10], np.int64))
    grown = grown.joined(np.array([[9, 10]]), np.array([[9, 10]]))
    gone, new = joined.changes(grown)
    assert (gone.tolist(), new.first.tolist(), new.last.tolist()) == ([9], [9], [10])
