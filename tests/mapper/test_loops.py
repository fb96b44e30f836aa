"""Large loops close although odometry has drifted beyond the search radius."""

import threading
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from tests.builders import Copied, Mapped, Sparse, World, drive, map_simulated, see

from engram.errors import MapCorruptError
from engram.geometry.se3 import SE3
from engram.graph.model import Edge, EdgeKind
from engram.mapper.loops import LoopConfig
from engram.maps.frame_reader import FrameReader
from engram.maps.map import Map
from engram.robot import drive_session

# A lap of 151 m with a step every 0.7 m: 0.17° a step too much is 37° and 17 m at its end.
LAP_M = 2 * np.pi * 24.0
RING = World(LAP_M, radius_m=24.0, seed=5)
DRIFT = SE3.exp([0.0, 0.0, 0.01, 0.0, -0.003, 0.0])
LAP_AND_A_HALF = np.arange(0.0, 1.5 * LAP_M, 0.7)
LAP_FRAMES = int(LAP_M / 0.7)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "ring.engram"


@pytest.fixture(scope="module")
def lapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Mapped]:
    """A map of a drifted lap and a half, and how it came about."""
    path = tmp_path_factory.mktemp("lapped") / "ring.engram"
    return path, map_simulated(path, drive(RING, LAP_AND_A_HALF, drift=DRIFT), closes_loops=True)


def loop_edges(path: Path, mapped: Mapped) -> list[tuple[Edge, SE3]]:
    """Measured edges between own nodes, each with its truth."""
    with Map.open(path) as store:
        edges = store.graph.edges
    truth = mapped.saved
    return [
        (edge, truth[edge.a].inverse() @ truth[edge.b])
        for edge in edges
        if edge.kind is EdgeKind.MATCH
    ]


def test_a_drifted_lap_is_closed_and_then_localised_in(lapped: tuple[Path, Mapped]) -> None:
    path, mapped = lapped
    dead_reckoned = SE3.identity()
    for seen in mapped.drive[1 : LAP_FRAMES + 1]:
        dead_reckoned = dead_reckoned @ seen.odometry.prev_from_curr
    assert dead_reckoned.distance_m > 2 * 8.0  # twice the search radius
    closures = loop_edges(path, mapped)
    assert closures
    for edge, truth in closures:
        # Two looks with 0.3 px noise at landmarks 5 to 40 m away.
        assert np.linalg.norm(edge.a_from_b.translation - truth.translation) < 0.3
    # It has to pass what the first match saw, 20 m at most.
    second = np.array(mapped.statuses[LAP_FRAMES + 40 :])
    assert (second == "localised").mean() > 0.9


def test_a_robot_that_knows_its_chain_asks_beside_the_drive_only(
    lapped: tuple[Path, Mapped],
) -> None:
    first_lap = lapped[1].steps[1 : LAP_FRAMES - 5]
    assert not any(one.looked_up for one in first_lap)


def test_a_robot_that_came_from_nowhere_asks_on_every_frame_until_it_is_found(path: Path) -> None:
    map_simulated(path, drive(RING, np.arange(0.0, 60.0, 0.7)))
    other_look = np.where(np.arange(40) < 20, 1, 0)
    live = drive(RING, 10 + np.arange(40) * 0.7, other_look, start_ns=10**15, seed=1)
    mapped = map_simulated(path, live, name="r2", closes_loops=True)
    assert all(step.attempts > 0 for step in mapped.steps[:20])
    assert mapped.statuses[20] == "localised"


def test_the_same_drive_gives_the_same_map(lapped: tuple[Path, Mapped], path: Path) -> None:
    map_simulated(path, drive(RING, LAP_AND_A_HALF, drift=DRIFT), closes_loops=True)
    with Map.open(lapped[0]) as first, Map.open(path) as again:
        assert first.content_hash() == again.content_hash()


def test_a_loop_that_closes_at_the_very_end_is_kept(path: Path) -> None:
    # The second lap looks different but for its last 22 metres.
    places = np.arange(0.0, LAP_M + 32.0, 0.7)
    look = np.where((places > LAP_M - 10) & (places < LAP_M + 9.5), 1, 0)
    mapped = map_simulated(path, drive(RING, places, look, drift=DRIFT), closes_loops=True)
    assert "localised" not in mapped.statuses
    assert len(loop_edges(path, mapped)) >= 2


@pytest.mark.parametrize("alike_m", [2.0, 6.0])
def test_a_place_that_looks_like_another_one_closes_no_loop(path: Path, alike_m: float) -> None:
    road = World(140.0, seed=6)
    driven = drive(road, np.arange(0.0, 140.0, 0.7))
    seen_again = [
        replace(seen, frame=see(road, road.pose_at(s - 70.0), seen.frame.stamp_ns))
        if 100.0 <= (s := float(seen.world_from_live.translation[2])) < 100.0 + alike_m
        else seen
        for seen in driven
    ]
    mapped = map_simulated(path, seen_again, closes_loops=True)
    assert loop_edges(path, mapped) == []
    assert "localised" not in mapped.statuses


@pytest.mark.parametrize(("own_share", "closes"), [(1e-9, True), (LoopConfig().own_share, False)])
def test_a_street_that_shares_a_third_with_one_before_it_closes_no_loop_with_it(
    path: Path, monkeypatch: pytest.MonkeyPatch, own_share: float, closes: bool
) -> None:
    """Nothing excuses the missing two thirds within one drive: it is neither darker nor wet."""
    monkeypatch.setattr(drive_session, "LoopConfig", partial(LoopConfig, own_share=own_share))
    road = Sparse(190.0, seed=6)
    copy = Copied(road, 0.35, evenly=True)
    driven = drive(road, np.arange(0.0, 190.0, 0.7))
    seen_again = [
        replace(seen, frame=see(copy, copy.pose_at(s - 100.0), seen.frame.stamp_ns))
        if (s := float(seen.world_from_live.translation[2])) >= 120.0
        else seen
        for seen in driven
    ]
    mapped = map_simulated(path, seen_again, closes_loops=True)
    assert bool(loop_edges(path, mapped)) is closes


def test_places_that_cannot_be_read_close_no_loop(path: Path, monkeypatch) -> None:
    readable = FrameReader.frame

    def frame(self, node):
        if threading.current_thread().name.startswith("engram-loops"):
            raise MapCorruptError(f"node {node}: does not match its checksum")
        return readable(self, node)

    monkeypatch.setattr(FrameReader, "frame", frame)
    places = np.arange(0.0, LAP_M + 20.0, 0.7)
    mapped = map_simulated(path, drive(RING, places, drift=DRIFT), closes_loops=True)
    assert len(mapped.steps) == len(places)
    assert loop_edges(path, mapped) == []


def test_a_road_that_looks_like_the_metres_before_carries_no_mapping_robot_back(
    path: Path,
) -> None:
    """Six metres look like those four metres before them, while an experience is being saved."""
    road, places = World(120.0, seed=6), np.arange(0.0, 100.0, 0.7)
    first = map_simulated(path, drive(road, np.arange(0.0, 110.0, 0.7)))
    looks = np.where((places < 15) | ((places > 20) & (places < 25)), 0, 1)
    seen = [
        replace(one, frame=see(road, road.pose_at(at - 4.0), one.frame.stamp_ns))
        if 36.5 <= at < 42.5
        else one
        for at, one in zip(places, drive(road, places, looks, start_ns=10**15, seed=1), strict=True)
    ]
    second = map_simulated(path, seen, name="r2", closes_loops=True)
    truth = first.saved | second.saved
    with Map.open(path) as store:
        edges = store.graph.edges
    assert any(edge.kind is EdgeKind.PROXIMITY for edge in edges)
    for edge in edges:
        true = truth[edge.a].inverse() @ truth[edge.b]
        assert np.linalg.norm(edge.a_from_b.translation - true.translation) < 1.0
