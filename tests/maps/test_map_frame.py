"""The frame of a map: goals stay with their nodes, anchors say where it is, exports can be read."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from tests.fleet.robots import merged, rewritten, robot_map
from tests.sequences.bag_maker import bag, made

from engram.errors import InputError
from engram.fleet.download.updating import update
from engram.graph.model import Clock
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.robot.anchors import add_goal, anchor_map, list_goals, read_anchors, remove_goal
from engram.robot.inspecting import Exported, export_map
from engram.sequences.motion_files import read_tum

PLACES_M = np.arange(0.0, 20.0, 1.0)
METRES_PER_DEGREE = 111_320 * np.cos(np.deg2rad(50.0))


@pytest.fixture(scope="module")
def road(tmp_path_factory):
    path = tmp_path_factory.mktemp("frame") / "road.engram"
    robot_map(path, PLACES_M)
    return path


@pytest.fixture
def copy(road, tmp_path):
    target = tmp_path / "copy.engram"
    target.write_bytes(road.read_bytes())
    return target


def count_of(path) -> int:
    with Map.open(path) as store:
        return len(store.graph)


def write_anchors(path, copy, head: str, line) -> None:
    """A CSV with a line for each node of a map, made of its id and place."""
    with Map.open(copy) as store:
        places = [(node.id, store.frame.pose(node.id).translation) for node in store.graph.nodes]
    path.write_text("\n".join([head, *(line(node, *place) for node, place in places)]))


def test_a_road_lies_along_x_and_its_places_are_stored(road):
    with Map.open(road) as store:
        assert len(store.placements) == len(store.graph)
        at = store.layout().positions
        assert np.ptp(at[:, 0]) == pytest.approx(19, abs=0.5)
        assert np.abs(at[:, 1:]).max() < 0.5


@pytest.mark.parametrize("pose", [(3.2, 0.5, 0.3), (11.0, -1.0, 3.0), (50.0, 4.0, -2.0)])
def test_goals_and_places_are_each_others_inverse(road, pose):
    with Map.open(road) as store:
        where = store.frame.locate(store.frame.goal(*pose))
    assert (where.x_m, where.y_m) == pytest.approx(pose[:2], abs=1e-9)
    assert where.yaw_rad == pytest.approx(pose[2], abs=0.02)  # nodes are level to some minutes


@pytest.mark.parametrize("pose", [(np.nan, 0.0, 0.0), (0.0, 1e300, 0.0), (0.0, 0.0, -1e10)])
def test_a_goal_beyond_any_map_is_refused(road, pose):
    with Map.open(road) as store, pytest.raises(InputError, match="at most 1e"):
        store.frame.goal(*pose)


def test_goals_survive_merges_and_say_how_far_they_moved(copy, tmp_path):
    add_goal(copy, "dock", 5.0, 1.0, 0.0, author="tests")
    centre = tmp_path / "centre.engram"
    merged(centre, copy)
    (before,) = list_goals(centre)
    robot_map(tmp_path / "r2.engram", PLACES_M + 10, name="r2", day=2)
    (report,) = merged(centre, tmp_path / "r2.engram")
    (after,) = list_goals(centre)
    assert (before["x_m"], before["y_m"]) == (after["x_m"], after["y_m"])
    assert not report.moved
    assert check_file(centre).problems == ()


def test_a_goal_is_removed_for_good_and_the_removal_can_be_undone(copy):
    for x_m in (5.0, 6.0):  # the second replaces the first
        add_goal(copy, "dock", x_m, 1.0, 0.0, author="tests")
    add_goal(copy, "gate", 9.0, 0.0, 0.0, author="tests")
    with pytest.raises(InputError, match="no goal 'dck'; its goals: dock, gate"):
        remove_goal(copy, "dck", author="tests")
    removed = remove_goal(copy, "dock", author="tests")
    assert [one["name"] for one in list_goals(copy)] == ["gate"]
    assert check_file(copy).problems == ()
    with Map.open(copy) as store:
        assert store.log()[-1].message == "remove goal dock"
        assert {one.name for one in store.seen_goals} == {"dock", "gate"}
        store.revert(removed["revision"], author="tests")
        assert store.frame.locate(store.goals["dock"]).x_m == pytest.approx(6.0)
    remove_goal(copy, "dock", author="tests")
    add_goal(copy, "dock", 5.0, 1.0, 0.0, author="tests")
    assert [one["name"] for one in list_goals(copy)] == ["dock", "gate"]


def test_a_removed_goal_does_not_come_back_with_a_hand_in_but_another_place_does(copy, tmp_path):
    centre, robot = tmp_path / "centre.engram", tmp_path / "robot.engram"
    add_goal(copy, "dock", 5.0, 1.0, 0.0, author="tests")
    merged(centre, copy)
    remove_goal(centre, "dock", author="tests")
    robot.write_bytes(copy.read_bytes())
    robot_map(robot, PLACES_M + 10, name="r1", day=2)
    merged(centre, robot)
    assert list_goals(centre) == []
    add_goal(robot, "dock", 7.0, 1.0, 0.0, author="tests")
    merged(centre, robot)
    assert [one["x_m"] for one in list_goals(centre)] == pytest.approx([7.0], abs=0.05)


def test_a_goal_that_a_robot_removed_does_not_come_back_with_an_update(copy, tmp_path):
    centre = tmp_path / "centre.engram"
    for name, x_m in (("dock", 5.0), ("gate", 9.0)):
        add_goal(copy, name, x_m, 1.0, 0.0, author="tests")
    merged(centre, copy)
    remove_goal(copy, "dock", author="tests")
    add_goal(centre, "ramp", 7.0, 0.0, 0.0, author="tests")
    update(centre, copy)
    assert [one["name"] for one in list_goals(copy)] == ["gate", "ramp"]


def test_anchors_move_the_frame_and_not_the_goals(copy, tmp_path):
    added = add_goal(copy, "dock", 5.0, 1.0, 0.0, author="tests")
    given = tmp_path / "here.csv"
    write_anchors(given, copy, "node,x,y,sigma", lambda node, x, y, _: f"{node},{100 - y},{x},0.1")
    preview = anchor_map(copy, given, author="tests", dry_run=True)
    assert preview.revision is None
    report = anchor_map(copy, given, author="tests")
    assert max(report.residuals_m.values()) < 0.05
    assert report.moved.goals["dock"] > 90
    (where,) = list_goals(copy)
    assert where["node"] == added["node"]
    assert (where["x_m"], where["y_m"]) == pytest.approx((99.0, 5.0), abs=0.05)
    with Map.open(copy) as store:
        store.revert(report.revision, author="tests")
    (where,) = list_goals(copy)
    assert (where["x_m"], where["y_m"]) == pytest.approx((5.0, 1.0), abs=0.01)
    assert check_file(copy).problems == ()


def test_gps_gives_a_place_on_earth(copy, tmp_path):
    given = tmp_path / "gps.csv"
    write_anchors(
        given, copy, "node,lat,lon", lambda node, x, y, _: f"{node},{50 + x / 111_320},14.0"
    )
    anchor_map(copy, given, author="tests")
    out = tmp_path / "road.geojson"
    assert export_map(copy, out) == Exported(count_of(copy), 0)
    points = [one["geometry"]["coordinates"] for one in json.loads(out.read_text())["features"]]
    assert max(point[1] for point in points) == pytest.approx(50 + 19 / 111_320, abs=1e-5)
    assert max(abs(point[0] - 14) for point in points) < 1e-5


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_the_fixes_of_a_bag_anchor_its_nodes_between_them(road, tmp_path, kind):
    """Nodes lie between two fixes, and the robot drives on meanwhile."""
    copy = rewritten(
        road, tmp_path / "copy.engram", session=lambda one: replace(one, clock=Clock.UTC)
    )
    with Map.open(copy) as store:
        found = [
            (node.stamp_ns, store.frame.pose(node.id).translation) for node in store.graph.nodes
        ]
    stamps, places = zip(*sorted(found, key=lambda one: one[0]), strict=True)
    stamps_ns, east_m = np.array(stamps), np.array(places)[:, 0]
    with bag(tmp_path / "gps", kind) as maker:
        for stamp_ns in range(int(stamps_ns[0]) + 30_000_000, int(stamps_ns[-1]), 170_000_000):
            here = 50.0, 14.0 + np.interp(stamp_ns, stamps_ns, east_m) / METRES_PER_DEGREE
            maker.fix("/gps/fix", stamp_ns, here)
            maker.fix("/gps/fix", stamp_ns + 1_000, (0.0, 0.0), status=-1)
    report = anchor_map(copy, made(tmp_path / "gps", kind), author="tests")
    assert report.anchors > 5
    assert max(report.residuals_m.values()) < 0.1
    with Map.open(copy) as store:
        assert store.frame.geographic(0.0, 0.0) == pytest.approx((50.0, 14.0), abs=1e-3)


def test_a_bag_of_two_receivers_asks_which(copy, tmp_path):
    with bag(tmp_path / "gps", "mcap") as maker:
        maker.fix("/gps/fix", 10**18, (50.0, 14.0), status=-1)
        maker.fix("/rtk/fix", 10**18, (50.0, 14.0))
    source = made(tmp_path / "gps", "mcap")
    with pytest.raises(InputError, match=r"--topic; topics with fixes: /gps/fix, /rtk/fix"):
        anchor_map(copy, source, author="tests")
    with pytest.raises(InputError, match="holds no fix"):
        anchor_map(copy, source, topic="/gps/fix", author="tests")
    with pytest.raises(InputError, match="none of the anchors belongs to one of the nodes of"):
        anchor_map(copy, source, topic="/rtk/fix", author="tests")


def test_exports_hold_every_node(copy, tmp_path):
    add_goal(copy, "dock", 5.0, 1.0, 0.0, author="tests")
    count = count_of(copy)
    assert export_map(copy, tmp_path / "road.tum") == Exported(count, 0)
    with Map.open(copy) as store:
        poses = read_tum(tmp_path / "road.tum").world_from_cam
        first = store.frame.pose(store.graph.nodes[0].id)
    assert (first.inverse() @ poses[0]).distance_m < 1e-6
    assert export_map(copy, tmp_path / "road.csv") == Exported(count, 1)
    rows = list(csv.DictReader((tmp_path / "road.csv").open()))
    assert [row["what"] for row in rows].count("node") == count
    assert rows[-1]["name"] == "dock"
    export_map(copy, tmp_path / "poses.txt", "kitti")
    assert np.loadtxt(tmp_path / "poses.txt").shape == (count, 12)
    with pytest.raises(InputError, match="anchor it with latitudes"):
        export_map(copy, tmp_path / "road.geojson")
    with pytest.raises(InputError, match="not a known format"):
        export_map(copy, tmp_path / "road.xyz")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("node,x,y\n", "holds no anchors"),
        ("node,x\na,1\n", "no position"),
        ("x,y\n1,2\n", "give either a node or a time"),
        ("node,x,y\na,one,2\n", "not a number"),
        ("node,lat,lon\na,91,2\n", "not latitude, longitude"),
        ("time,x,y\nnoon,1,2\n", "line 2"),
        ("node,x,y\na,1e300,2\n", "at most 1e"),
        ("node,x,y,sigma\na,1,2,0\n", "sigma"),
        ("node,x,y,sigma\na,1,2,1e-300\n", "sigma"),
    ],
)
def test_what_is_wrong_with_a_file_of_anchors_is_said(tmp_path, text, said):
    path = tmp_path / "anchors.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_anchors(path)


def test_a_broken_geojson_is_said(tmp_path):
    path = tmp_path / "anchors.geojson"
    path.write_text('{"features": [{"geometry": null}]}')
    with pytest.raises(InputError, match="not a GeoJSON"):
        read_anchors(path)


def test_anchors_need_a_direction(copy, tmp_path):
    with Map.open(copy) as store:
        node = store.graph.nodes[0].id
    (tmp_path / "one.csv").write_text(f"node,x,y\n{node},0,0\n")
    with pytest.raises(InputError, match="direction"):
        anchor_map(copy, tmp_path / "one.csv", author="tests")
