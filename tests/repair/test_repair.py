"""A wrong edge is found, taken out, stays out, and comes back when the repair is reverted."""

import shutil

import numpy as np
import pytest
from tests.builders import covariance_of, forward, make_edge
from tests.fleet.robots import merged, robot_map

from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.graph.model import Edge, EdgeKind, Removal, Removed
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.repair.finding import Crossings, RepairConfig, find_wrong_edges
from engram.repair.repairing import check_geometry
from engram.testing.contracts import make_node

PLACES_M = np.arange(0.0, 30.0, 1.0)


def join(path, from_m: float, to_m: float, wrong: bool = True) -> float:
    """Adds a match between the nodes of a map nearest to two places; returns their distance."""
    with Map.open(path, writes=True) as store:
        driven_m = store.graph.driven_m
        a, b = (int(np.argmin(np.abs(driven_m - m))) for m in (from_m, to_m))
        nodes, apart_m = store.graph.nodes, float(driven_m[b] - driven_m[a])
        pose = forward(0.4 if wrong else apart_m)
        edge = Edge(nodes[a].id, nodes[b].id, EdgeKind.MATCH, pose, covariance_of(0.04, 0.005))
        with store.begin_revision(author="tests", message="a join", configuration={}) as writer:
            writer.add_edge(edge)
            writer.commit()
    return apart_m


def matches(path) -> int:
    with Map.open(path) as store:
        return sum(edge.kind is EdgeKind.MATCH for edge in store.graph.edges)


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """A drive along a road, one of whose first places is joined with one 20 m on."""
    path = tmp_path_factory.mktemp("repair") / "road.engram"
    robot_map(path, PLACES_M)
    join(path, 3.0, 23.0)
    return path


@pytest.fixture
def road(given, tmp_path):
    return shutil.copy(given, tmp_path / "road.engram")


def test_a_wrong_edge_is_found_and_nothing_else(road):
    report = check_geometry(road)
    (wrong,) = report.findings.wrong
    assert wrong.edge.kind is EdgeKind.MATCH
    assert wrong.why == "contradicted"
    assert wrong.off_m == pytest.approx(20, abs=2)
    assert report.revision is None
    assert "off the rest of the map" in report.text()
    assert matches(road) == 1


def test_a_repair_is_a_revision_that_can_be_reverted_and_done_again(road):
    with Map.open(road) as store:
        before = store.content_hash()
    report = check_geometry(road, author="tests")
    assert matches(road) == 0
    assert check_geometry(road).findings.wrong == ()
    with Map.open(road) as store:
        (removal,) = store.removals
        assert "off the rest" in removal.reason
        assert store.info().edges_of_kind.get("match", 0) == 0
        assert store.content_hash() != before
        store.revert(report.revision, author="tests")
    assert matches(road) == 1
    check_geometry(road, author="tests")
    assert matches(road) == 0
    assert check_file(road).problems == ()


def test_what_was_removed_stays_removed_when_it_is_handed_in_again(road, tmp_path):
    centre = tmp_path / "centre.engram"
    merged(centre, road)
    check_geometry(centre, author="tests")
    again = shutil.copy(road, tmp_path / "again.engram")
    assert not merged(centre, again)[0].changed
    assert matches(centre) == 0
    # A download carries the removal, and brings the edge back nowhere.
    sent = tmp_path / "sent.engram"
    download(centre, sent, DownloadOptions("copy"))
    with Map.open(sent) as store:
        assert len(store.removals) == 1
        assert store.placements.keys() == {node.id for node in store.graph.nodes}
    assert matches(sent) == 0
    # Another measurement between the same nodes counts.
    join(again, 3.0, 23.0, wrong=False)
    assert merged(centre, again)[0].edges == 1
    assert matches(centre) == 1


def test_a_robots_repair_reaches_the_fleet(road, tmp_path):
    centre = tmp_path / "centre.engram"
    merged(centre, road)
    assert matches(centre) == 1
    check_geometry(road, author="tests")
    merged(centre, road)
    assert matches(centre) == 0
    known = check_file(centre)
    assert known.problems == ()
    assert merged(centre, road)[0].revision is None


def test_a_right_edge_is_left_alone(road):
    with Map.open(road) as store:
        store.revert(store.revision, author="tests")
    join(road, 3.0, 23.0, wrong=False)
    assert check_geometry(road).findings.wrong == ()


def test_pictures_show_both_sides(road, tmp_path):
    report = check_geometry(road, pictures=tmp_path / "suspects")
    assert report.pictures == len(list((tmp_path / "suspects").iterdir()))


def test_a_removal_is_of_one_measurement_in_either_direction():
    a, b = (make_node(0, index).id for index in range(2))
    removed = Removed([Removal(a, b, EdgeKind.MATCH, forward(1.0), "", 1)])
    assert make_edge(a, b, forward(1.3), EdgeKind.MATCH) in removed
    assert make_edge(b, a, forward(1.0).inverse(), EdgeKind.MATCH) in removed
    assert make_edge(a, b, forward(3.0), EdgeKind.MATCH) not in removed
    assert make_edge(a, b, forward(1.0), EdgeKind.TIE) not in removed
    assert make_edge(a, b, forward(1.0, yaw_rad=0.3), EdgeKind.MATCH) not in removed


@pytest.mark.parametrize(
    ("walk", "expected"),
    [
        ([0, 1, 2, 7, 8, 9], 3),
        ([0, 1, 2, 5, 5, 7, 8], 2),
        ([9, 8, 0], 1),
        ([0, 1, 2], 0),
        ([0, *[5] * 20, 7], 0),  # too long in between
    ],
)
def test_a_drive_that_crossed_is_a_witness(walk, expected):
    crossings = Crossings((np.array(walk),))
    assert crossings.witnessed({0, 1, 2}, {7, 8, 9}, 10, pause=8) == expected
    adjacent = crossings.witnessed({0, 1, 2}, {7, 8, 9}, 10, pause=1)
    assert adjacent == (0 if 5 in walk else expected)


def test_an_empty_map_has_no_wrong_edges(tmp_path):
    path = tmp_path / "empty.engram"
    Map.create(path).close()
    with Map.open(path) as store:
        found = find_wrong_edges(store.graph, store.path_memory, store.frames, RepairConfig())
    assert found.wrong == ()
    assert found.of_edges == 0
