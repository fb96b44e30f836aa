"""The EBN loop on simulated drives, from the frames to the map on disk."""

import dataclasses
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from tests.builders import (
    Mapped,
    Seen,
    World,
    drive,
    errors_m,
    localise_simulated,
    map_simulated,
)

from engram.frontend.frame import FrameStatus, Landmarks
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import EdgeKind, PathEntryKind
from engram.graph.neighbourhood import Search
from engram.graph.proximity import ProximityConfig
from engram.mapper.mapper import MapperConfig
from engram.maps.map import Map
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.settings import Settings

WORLD = World(60.0)
ROAD = np.arange(0.0, 55.0, 0.7)
LATER_NS = 10**15


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "town.engram"


@pytest.fixture(scope="module")
def driven_once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Mapped]:
    """A map of the road, and how it came about."""
    path = tmp_path_factory.mktemp("road") / "town.engram"
    return path, map_simulated(path, drive(WORLD, ROAD))


@pytest.fixture
def first(driven_once: tuple[Path, Mapped], path: Path) -> Mapped:
    """The road's map is at `path`, for the test to drive on in."""
    made, mapped = driven_once
    shutil.copy(made, path)
    return mapped


def graph_of(path: Path) -> ExperienceGraph:
    with Map.open(path) as store:
        return store.graph


def looks(first: int, last: int) -> np.ndarray:
    """Another appearance of the world from one frame to another."""
    appearance = np.zeros(len(ROAD), dtype=int)
    appearance[first:last] = 1
    return appearance


def test_a_first_session_saves_everything_in_one_chain(first: Mapped, path: Path) -> None:
    assert set(first.statuses) <= {"dead_reckoning", "lost"}
    graph = graph_of(path)
    # A frame every 0.7 m, a node once 1 m has been driven: every second frame.
    assert len(graph) == len(first.saved) == (len(ROAD) + 1) // 2
    assert [edge.kind for edge in graph.edges] == [EdgeKind.ODOMETRY] * (len(graph) - 1)
    assert len(set(graph.experiences.tolist())) == 1


def test_while_localisation_succeeds_nothing_is_saved(first: Mapped, path: Path) -> None:
    again = map_simulated(path, drive(WORLD, ROAD + 0.3, seed=1, start_ns=LATER_NS), "r2")
    assert again.statuses.count("localised") == len(ROAD)
    assert not again.saved
    found = again.steps
    errors = errors_m(found, again.drive, first.saved)
    # Pixel noise of 0.3 px on points 4 to 40 m away.
    assert np.median(errors) < 0.03
    assert errors.max() < 0.3


@pytest.mark.parametrize(("sure_inliers", "share"), [(0, 0.0), (10_000, 0.5)])
def test_a_frame_that_matches_weakly_is_saved_unless_as_published(
    path: Path, sure_inliers: int, share: float
) -> None:
    settings = Settings(mapper=MapperConfig(sure_inliers=sure_inliers))
    first = map_simulated(path, drive(WORLD, ROAD), settings=settings)
    seen = drive(WORLD, ROAD + 0.3, seed=1, start_ns=LATER_NS)
    again = map_simulated(path, seen, "r2", settings=settings)
    assert again.statuses.count("localised") == len(ROAD)
    assert len(again.saved) == pytest.approx(share * len(ROAD), abs=2)
    assert np.median(errors_m(again.steps, again.drive, first.saved)) < 0.03
    graph = graph_of(path)
    tied = {edge.b for edge in graph.edges if edge.kind is EdgeKind.TIE and edge.a in first.saved}
    assert set(again.saved) <= tied
    # Matched all along, they need no dead reckoning to be neighbours of what is there.
    assert all(edge.kind is not EdgeKind.PROXIMITY for edge in graph.edges)
    assert len(set(graph.experiences.tolist())) == 1 + bool(again.saved)


@pytest.mark.usefixtures("first")
def test_another_appearance_becomes_an_experience_beside_the_known_one(path: Path) -> None:
    seen = drive(WORLD, ROAD, looks(20, 50), seed=1, start_ns=LATER_NS)
    mapped = map_simulated(path, seen, "r2")
    statuses = np.array(mapped.statuses)
    assert (statuses[:20] == "localised").all()
    assert (statuses[20:50] != "localised").all()
    # Past 10 m the robot is lost; where the known appearance returns it is found again.
    assert (statuses[55:] == "localised").all()
    assert len(mapped.saved) == pytest.approx(30 * 0.7 / 1.4, abs=2)

    graph = graph_of(path)
    new = {graph.index(node) for node in mapped.saved}
    ties = [edge for edge in graph.edges if edge.kind is EdgeKind.TIE]
    tied = {graph.index(end) for edge in ties for end in (edge.a, edge.b)} & new
    assert {min(new), max(new)} <= tied  # on both sides
    assert any(edge.kind is EdgeKind.PROXIMITY for edge in graph.edges)
    assert len(set(graph.components().tolist())) == 1


def test_the_settings_say_which_nodes_are_joined_by_dead_reckoning(path: Path) -> None:
    settings = Settings(mapper=MapperConfig(proximity=ProximityConfig(greatest_sigma_m=0.0)))
    map_simulated(path, drive(WORLD, ROAD), settings=settings)
    seen = drive(WORLD, ROAD, looks(20, 50), seed=1, start_ns=LATER_NS)
    map_simulated(path, seen, "r2", settings=settings)
    kinds = {edge.kind for edge in graph_of(path).edges}
    assert EdgeKind.TIE in kinds
    assert EdgeKind.PROXIMITY not in kinds


def test_a_parallel_experience_is_in_the_neighbourhood(first: Mapped, path: Path) -> None:
    seen = drive(WORLD, ROAD, looks(10, 60), seed=1, start_ns=LATER_NS)
    second = map_simulated(path, seen, "r2")
    graph = graph_of(path)
    seen_count = beside_count = 0
    for node, world_from_node in first.saved.items():
        near = graph.neighbourhood(
            graph.index(node), SE3.identity(), np.zeros((6, 6)), Search(8.0, 1.0)
        )
        found = {graph.node(index).id for index in near.nodes.tolist()}
        for other, world_from_other in second.saved.items():
            if (world_from_node.inverse() @ world_from_other).distance_m <= 8.0:
                beside_count += 1
                seen_count += other in found
    assert seen_count / beside_count >= 0.95


@pytest.mark.usefixtures("first")
def test_paths_hold_what_was_matched_and_what_was_saved(path: Path) -> None:
    seen = drive(WORLD, ROAD, looks(40, 99), seed=1, start_ns=LATER_NS)
    mapped = map_simulated(path, seen, "r2")
    with Map.open(path) as store:
        memory = store.path_memory
    assert len(memory.paths) == 2
    entries = memory.entries(memory.paths[1])
    saved = [entry.node for entry in entries if entry.kind is PathEntryKind.SAVED]
    assert saved == list(mapped.saved)
    matched = [entry.node for entry in entries if entry.kind is PathEntryKind.MATCHED]
    assert len(matched) == pytest.approx(40 * 0.7 / 1.4, abs=2)  # each node once
    assert all(a != b for a, b in pairwise(matched))


def test_a_drive_closes_its_own_loop(path: Path) -> None:
    lap_m = 2 * np.pi * 12.0
    ring = World(lap_m, radius_m=12.0)
    mapped = map_simulated(path, drive(ring, np.arange(0.0, 1.5 * lap_m, 0.7)))
    lap = int(lap_m / 0.7)
    # In the second lap the first one's nodes are more than 30 m back.
    second = np.array(mapped.statuses[lap + 8 :])
    assert (second == "localised").mean() > 0.9
    assert len(set(graph_of(path).components().tolist())) == 1


def test_unusable_frames_are_neither_saved_nor_matched(path: Path) -> None:
    seen = drive(WORLD, ROAD)
    for i in range(10, 15):
        dark = dataclasses.replace(seen[i].frame, status=FrameStatus.DARK)
        nothing = OdometryStep(OdometryStatus.UNUSABLE_FRAME)
        seen[i] = dataclasses.replace(seen[i], frame=dark, odometry=nothing)
    across = seen[9].world_from_live.inverse() @ seen[15].world_from_live
    bridging = dataclasses.replace(seen[15].odometry, prev_from_curr=across)
    seen[15] = dataclasses.replace(seen[15], odometry=bridging)
    mapped = map_simulated(path, seen)
    assert mapped.statuses[10:15] == ["no_odometry"] * 5
    assert not any(step.saved for step in mapped.steps[10:15])
    # The motion across the gap was measured: still one chain.
    assert len(set(graph_of(path).experiences.tolist())) == 1


@pytest.mark.parametrize(("lost", "components"), [(2, 1), (3, 1), (12, 2)])
def test_a_chain_bears_short_gaps_of_odometry_and_breaks_at_long_ones(
    path: Path, lost: int, components: int
) -> None:
    seen = drive(WORLD, ROAD)
    lost_track = OdometryStep(OdometryStatus.NO_CONSENSUS)
    for i in range(20, 20 + lost):
        seen[i] = dataclasses.replace(seen[i], odometry=lost_track)
    map_simulated(path, seen)
    graph = graph_of(path)
    assert len(set(graph.components().tolist())) == components
    vague = [edge for edge in graph.edges if edge.covariance[0, 0] > 0.1]
    assert vague
    for edge in vague:  # the robot went on straight, as was guessed
        assert edge.a_from_b.distance_m < 3.0
        assert abs(edge.a_from_b.translation[0]) < 0.5


def test_a_chain_breaks_where_the_images_go_on_elsewhere(path: Path) -> None:
    """One step fails between frames of which each alone is good: they are not neighbours."""
    seen = drive(WORLD, ROAD)
    seen[25] = dataclasses.replace(seen[25], odometry=OdometryStep(OdometryStatus.NO_CONSENSUS))
    map_simulated(path, seen)
    graph = graph_of(path)
    assert len(set(graph.components().tolist())) == 2


def test_a_short_gap_after_a_long_one_is_borne_again(path: Path) -> None:
    seen = drive(WORLD, ROAD)
    lost_track = OdometryStep(OdometryStatus.NO_CONSENSUS)
    for i in (*range(20, 32), 33):  # 32 is measured, and saved as a new beginning
        seen[i] = dataclasses.replace(seen[i], odometry=lost_track)
    map_simulated(path, seen)
    assert len(set(graph_of(path).components().tolist())) == 2


@pytest.mark.usefixtures("first")
def test_the_same_input_gives_the_same_map(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.engram"
    map_simulated(other, drive(WORLD, ROAD))
    hashes = set()
    for one in (path, other):
        seen = drive(WORLD, ROAD, looks(30, 50), seed=1, start_ns=LATER_NS)
        map_simulated(one, seen, "r2")
        with Map.open(one) as store:
            hashes.add(store.content_hash())
    assert len(hashes) == 1


def test_a_robot_switched_on_anywhere_finds_itself(first: Mapped, path: Path) -> None:
    for start in np.random.default_rng(0).uniform(0, 40, 8):
        seen = drive(WORLD, np.arange(start, start + 10, 0.4), seed=2, start_ns=LATER_NS)
        found = localise_simulated(path, seen)
        # 40 nodes at four attempts a frame: the whole map within ten frames.
        assert [one.status.value for one in found[10:]] == ["localised"] * len(found[10:])
        assert errors_m(found, seen, first.saved).max() < 0.5


def test_a_kidnapped_robot_is_found_again(first: Mapped, path: Path) -> None:
    here = drive(WORLD, np.arange(0, 10, 0.4), seed=2, start_ns=LATER_NS)
    there = drive(WORLD, np.arange(35, 45, 0.4), seed=3, start_ns=2 * LATER_NS)
    lost_track = OdometryStep(OdometryStatus.NO_CONSENSUS)
    there[0] = dataclasses.replace(there[0], odometry=lost_track)
    found = localise_simulated(path, here + there)
    assert all(one.node is not None for one in found[-10:])
    assert errors_m(found, here + there, first.saved).max() < 0.5


def with_more(seen: Seen, own: int) -> Seen:
    """The step with the first `own` landmarks of its frame, which has the others further."""
    whole = seen.frame

    def further(count: int) -> Landmarks:
        return whole.landmarks.rows(slice(own, count))

    return dataclasses.replace(seen, frame=dataclasses.replace(whole.first(own), further=further))


# Of 512 × 384 px; the camera has 1.56 times as many pixels.
@pytest.mark.parametrize(("landmarks", "expected"), [(0, 250), (200, 261)])
def test_a_node_has_more_landmarks_than_the_live_frame(
    landmarks: int, expected: int, path: Path
) -> None:
    steps = [with_more(seen, 250) for seen in drive(WORLD, ROAD[:20])]
    map_simulated(path, steps, settings=Settings(mapper=MapperConfig(landmarks=landmarks)))
    with Map.open(path) as store:
        nodes = [store.frames.frame(node.id) for node in store.graph.nodes]
    live = {seen.frame.stamp_ns: seen.frame.landmarks.descriptors for seen in steps}
    assert len(nodes) >= 10
    for node in nodes:
        assert len(node.landmarks) == expected
        np.testing.assert_array_equal(node.landmarks.descriptors[:250], live[node.stamp_ns])
