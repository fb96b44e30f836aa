"""What a merge takes, omits and ties; that it may be repeated; that nothing is half done."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.builders import World, attempts_of, drive, map_simulated, see

from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.merge.report import Reason, Seed
from engram.graph.model import EdgeKind, PathEntryKind, path_id
from engram.graph.placing import PlacingConfig
from engram.graph.proximity import ProximityConfig
from engram.localiser.localiser import Localiser
from engram.mapper.mapper import MapperConfig
from engram.maps.map import Map, open_map
from engram.maps.map_files import check_file
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive

from .robots import OPTIONS, frame_log, merged, robot_map, truth_of


def assert_sound(path) -> None:
    assert check_file(path).problems == ()


def test_an_empty_centre_takes_everything_to_the_byte(tmp_path, fleet):
    centre, (robot, _) = tmp_path / "centre.engram", fleet["first"]
    (report,) = merged(centre, robot)
    with Map.open(centre) as ours, Map.open(robot) as theirs:
        mine, given = ours.load(), theirs.load()
        assert mine.nodes == given.nodes
        assert mine.sessions == given.sessions
        assert mine.path_entries == given.path_entries
        assert ours.landmark_hashes == theirs.landmark_hashes
        assert ours.omissions == {}
        for session in given.sessions:
            kept = attempts_of(mine, session.id)[: len(attempts_of(given, session.id))]
            assert kept == attempts_of(given, session.id)
    assert (report.taken, report.omitted, report.revision) == (len(given.nodes), 0, 1)
    assert report.segments[0].seed is Seed.NONE
    assert_sound(centre)


def test_a_drive_through_streets_that_look_alike_is_not_folded_onto_itself(tmp_path):
    road, centre = World(100.0, seed=6), tmp_path / "centre.engram"
    seen_again = [
        replace(seen, frame=see(road, road.pose_at(s - 50.0), seen.frame.stamp_ns))
        if 70.0 <= (s := float(seen.world_from_live.translation[2])) < 82.0
        else seen
        for seen in drive(road, np.arange(0.0, 100.0, 0.8))
    ]
    mapped = map_simulated(tmp_path / "robot.engram", seen_again, closes_loops=True)
    (report,) = merged(centre, tmp_path / "robot.engram")
    assert (report.taken, report.omitted) == (len(mapped.saved), 0)
    with Map.open(centre) as store:
        frame, edges = store.layout(), store.graph.edges
    truth = truth_of(mapped)
    for edge in edges:
        true = truth[edge.a].inverse() @ truth[edge.b]
        assert (true.inverse() @ edge.a_from_b).distance_m < 5.0
    for node, true in truth.items():
        assert abs(frame.pose(node).translation[0] - true.translation[2]) < 5.0


def test_what_localises_is_omitted_and_remembered_where_it_lies(tmp_path, fleet):
    centre = tmp_path / "centre.engram"
    (first, mapped_first), (same, mapped_same) = fleet["first"], fleet["same"]
    _, report = merged(centre, first, same)
    assert report.omitted >= 0.9 * len(mapped_same.saved)
    assert report.components == 1
    truth = truth_of(mapped_first, mapped_same)
    with Map.open(centre) as store:
        omissions = store.omissions
        sessions = {session.robot: session for session in store.load().sessions}
        entries = store.load().path_entries
    assert len(omissions) == report.omitted
    for omitted, omission in omissions.items():
        true = truth[omission.node].inverse() @ truth[omitted]
        error = true.inverse() @ omission.node_from_omitted
        assert error.distance_m < 0.15  # 0.3 px of noise at up to 40 m
    # The robot's own entries keep their numbers and stand at the equivalents; then what the
    # replay matched.
    own = [entry for entry in entries if entry.path == path_id(sessions["r2"].id)]
    with Map.open(same) as store:
        given = store.load().path_entries
    assert [entry.sequence for entry in own[: len(given)]] == [one.sequence for one in given]
    for entry, one in zip(own, given, strict=False):
        expected = omissions[one.node].node if one.node in omissions else one.node
        assert entry.node == expected
    replayed = own[len(given) :]
    assert replayed
    assert {entry.kind for entry in replayed} == {PathEntryKind.REPLAYED}
    assert replayed[0].sequence == 2**32
    assert_sound(centre)


def test_a_run_that_does_not_localise_is_taken_and_tied_where_it_began(tmp_path, fleet):
    centre = tmp_path / "centre.engram"
    (first, mapped_first), (longer, mapped_longer) = fleet["first"], fleet["longer"]
    _, report = merged(centre, first, longer)
    assert report.omitted >= 7
    assert report.taken >= 6
    assert report.components == 1
    (segment,) = report.segments
    assert segment.seed is Seed.PLACE
    assert sum(run.nodes for run in segment.runs) == segment.taken
    truth = truth_of(mapped_first, mapped_longer)
    with open_map(centre) as opened:
        graph = opened.graph
        a = graph.index(min(mapped_first.saved, key=lambda one: truth[one].translation[2]))
        b = graph.index(
            max(
                (node for node in mapped_longer.saved if node in graph),
                key=lambda one: truth[one].translation[2],
            )
        )
        predicted, _ = graph.predict(a, b)
        true = truth[graph.node(a).id].inverse() @ truth[graph.node(b).id]
        # 1 % of odometry noise a step over 60 m, and a tie.
        assert (predicted.translation - true.translation)[2] == pytest.approx(0, abs=1.0)
        kinds = {edge.kind for edge in graph.edges}
    assert EdgeKind.TIE in kinds
    assert_sound(centre)


def test_what_finds_no_place_becomes_a_component_of_its_own(tmp_path, fleet):
    centre = tmp_path / "centre.engram"
    (first, _), (other, mapped_other) = fleet["first"], fleet["other"]
    _, report = merged(centre, first, other)
    assert (report.taken, report.omitted) == (len(mapped_other.saved), 0)
    assert report.components == 2
    (segment,) = report.segments
    assert segment.seed is Seed.NONE
    assert [run.reason for run in segment.runs] == [Reason.NO_PLACE]
    # Every node was looked for elsewhere, and within the budget of those that know their place.
    assert report.lookups == report.taken
    assert report.match_attempts == report.proposed_attempts
    assert 0 < report.match_attempts <= report.taken * OPTIONS.lanes * OPTIONS.rounds
    assert_sound(centre)


@pytest.mark.parametrize("apart_m", [20.0, 70.0])
def test_the_settings_say_how_far_components_stand_apart(tmp_path, fleet, apart_m):
    settings = Settings(placing=PlacingConfig(apart_m=apart_m))
    centre, (first, _), (other, mapped) = tmp_path / "centre.engram", fleet["first"], fleet["other"]
    merged(centre, first, other, settings=settings)
    with Map.open(centre) as store:
        new = [store.graph.index(node) for node in mapped.saved]
        along_m = store.layout().positions[:, 0]
    gap_m = along_m[new].min() - np.delete(along_m, new).max()
    assert gap_m == pytest.approx(apart_m, abs=1e-6)


@pytest.mark.parametrize("kept", [True, False])
def test_the_settings_say_what_dead_reckoning_joins_in_a_merge(tmp_path, fleet, kept):
    proximity = ProximityConfig() if kept else ProximityConfig(greatest_sigma_m=0.0)
    settings = Settings(mapper=MapperConfig(proximity=proximity))
    centre, dusk = tmp_path / "centre.engram", tmp_path / "dusk.engram"
    robot_map(dusk, np.arange(0, 16, 0.8), np.arange(20) // 10, name="r5", day=5)
    merged(centre, fleet["first"][0], dusk, settings=settings)
    with Map.open(centre) as store, Map.open(dusk) as theirs, Map.open(fleet["first"][0]) as own:
        known = {edge.kind for one in (theirs, own) for edge in one.graph.edges}
        made = {edge.kind for edge in store.graph.edges}
    assert EdgeKind.PROXIMITY not in known
    assert (EdgeKind.PROXIMITY in made) == kept


@pytest.mark.parametrize("names", [("first",), ("first", "same"), ("first", "longer", "other")])
def test_handing_in_the_same_again_changes_nothing(tmp_path, fleet, names):
    centre = tmp_path / "centre.engram"
    robots = [fleet[name][0] for name in names]
    before = merged(centre, *robots)[-1]
    again = merged(centre, *robots)
    assert [report.revision for report in again] == [None] * len(names)
    assert not any(report.changed for report in again)
    assert again[-1].content_hash == before.content_hash
    with Map.open(centre) as store:
        assert store.revision == len(names)
    assert check_file(centre).abandoned_rows == 0


def test_the_same_in_the_same_order_gives_the_same_map(tmp_path, fleet):
    robots = [fleet[name][0] for name in ("same", "first", "longer", "other")]
    together = merged(tmp_path / "a.engram", *robots)[-1]
    for robot in robots:
        (alone,) = merged(tmp_path / "b.engram", robot)
    assert alone.content_hash == together.content_hash


def test_a_robot_goes_out_with_the_centre_and_hands_back_what_it_added(tmp_path, fleet):
    centre, robot = tmp_path / "centre.engram", tmp_path / "robot.engram"
    merged(centre, fleet["first"][0])
    shutil.copy(centre, robot)
    back = robot_map(robot, np.arange(6, 40, 0.8), 0, name="r1", day=9)
    assert 0 < len(back.saved) < 40
    (report,) = merged(centre, robot)
    assert report.known == len(fleet["first"][1].saved)
    assert report.components == 1
    assert {segment.seed for segment in report.segments} == {Seed.NEIGHBOUR}
    # What the robot could not localise the centre cannot either: it holds nothing else.
    assert report.taken == len(back.saved)
    with Map.open(centre) as ours, Map.open(robot) as theirs:
        mine, given = ours.load(), theirs.load()
        assert set(mine.path_entries) >= set(given.path_entries)
        edges = {(edge.a, edge.b, edge.kind) for edge in mine.edges}
        assert edges >= {(edge.a, edge.b, edge.kind) for edge in given.edges}
    assert not merged(centre, robot)[0].changed
    assert_sound(centre)


def test_the_author_is_whoever_added_something(tmp_path, fleet):
    centre, robot = tmp_path / "centre.engram", tmp_path / "robot.engram"
    merged(centre, fleet["first"][0])
    shutil.copy(centre, robot)
    robot_map(robot, np.arange(6, 40, 0.8), 0, name="r9", day=9)
    merged(centre, robot)
    with Map.open(centre) as store:
        first, second = store.log()
    assert (first.author, second.author) == ("r1", "r9")
    assert second.message == "merge r9"


def test_later_robots_localise_in_what_earlier_ones_of_the_merge_brought(tmp_path, fleet):
    robot = tmp_path / "two-days.engram"
    shutil.copy(fleet["other"][0], robot)
    twin = tmp_path / "twin.engram"
    robot_map(twin, np.arange(0, 24, 0.8), 1, name="r5", day=6, aside_m=0.2)
    # Two drives alike in one map that never met: the second finds the first one's nodes.
    both = tmp_path / "both.engram"
    merged(both, robot, twin)
    centre = tmp_path / "centre.engram"
    merged(centre, fleet["first"][0])
    (report,) = merged(centre, both)
    assert report.components == 2
    assert report.known_omissions == 0
    with Map.open(both) as store, Map.open(centre) as ours:
        # The omissions of the map handed in go along.
        assert set(ours.omissions) >= set(store.omissions)
        assert report.omitted >= len(store.omissions)


def test_a_node_is_omitted_only_for_a_sure_match(tmp_path, fleet):
    path = tmp_path / "robot.engram"
    robot_map(path, np.arange(0, 24, 0.8), name="r5", day=5, aside_m=0.1)
    with Map.open(path) as store:
        all_nodes = {node.id for node in store.graph.nodes}

    def taken_by(centre, sure_inliers):
        _, report = merged(
            centre, fleet["first"][0], path, asked=replace(OPTIONS, sure_inliers=sure_inliers)
        )
        with Map.open(centre) as store:
            contents, omitted = store.load(), set(store.omissions)
        taken = all_nodes - omitted
        assert taken <= {node.id for node in contents.nodes}
        assert report.taken == len(taken)
        assert report.components == 1
        assert_sound(centre)
        return taken, contents, report

    every, contents, _ = taken_by(tmp_path / "every.engram", 0)
    assert every == set()
    inliers = contents.attempts.inliers[contents.attempts.accepted]
    some, _, _ = taken_by(tmp_path / "some.engram", int(np.percentile(inliers, 85)))
    most, contents, report = taken_by(tmp_path / "most.engram", 10_000)
    assert set() < some < most == all_nodes
    assert {run.reason for one in report.segments for run in one.runs} == {Reason.WEAK_MATCH}
    matched = {edge.b for edge in contents.edges if edge.kind is EdgeKind.MATCH}
    assert most <= matched
    (again,) = merged(tmp_path / "most.engram", path)
    assert not again.changed


def test_two_parts_of_the_centre_are_joined_by_a_drive_through_both(tmp_path):
    centre = tmp_path / "centre.engram"
    parts = [tmp_path / "a.engram", tmp_path / "b.engram"]
    robot_map(parts[0], np.arange(0, 14, 0.8), 0, name="r1", day=1)
    robot_map(parts[1], np.arange(14, 36, 0.8), 1, name="r2", day=2)
    *_, before = merged(centre, *parts)
    assert before.components == 2
    through = tmp_path / "through.engram"
    places_m = np.arange(0, 36, 0.8)
    robot_map(through, places_m, np.where(places_m < 14, 0, 1), name="r3", day=3)
    (report,) = merged(centre, through)
    # It changes over within a few metres: until the localiser counts as lost it tries what is near.
    assert report.omitted > 0.75 * (report.omitted + report.taken)
    assert report.components == 1
    assert not merged(centre, through)[0].changed


def test_attempts_go_along_to_the_equivalents(tmp_path, fleet):
    centre = tmp_path / "centre.engram"
    (first, _), (same, _) = fleet["first"], fleet["same"]
    robot = tmp_path / "robot.engram"
    shutil.copy(same, robot)
    again = robot_map(robot, np.arange(0, 24, 0.8), 0, name="r2", day=7, aside_m=-0.4)
    assert len(again.saved) < 5
    _, report = merged(centre, first, robot)
    with Map.open(centre) as ours, Map.open(robot) as theirs:
        mine, given = ours.load(), theirs.load()
        omissions = ours.omissions
    (drive,) = [
        one for one in given.sessions if one.start_ns == max(s.start_ns for s in given.sessions)
    ]
    made, kept = attempts_of(given, drive.id), attempts_of(mine, drive.id)
    assert report.attempts > 0
    assert len(kept) >= len(made) > 20
    for one, now in zip(made, kept, strict=False):
        assert (now.iteration, now.accepted, now.inliers) == (
            one.iteration,
            one.accepted,
            one.inliers,
        )
        if one.node in omissions:
            moved = omissions[one.node].node_from_omitted @ np.array(
                [[one.across_m, 0.0, one.along_m]]
            )
            assert now.node == omissions[one.node].node
            assert (now.across_m, now.along_m) == pytest.approx(moved[0, [0, 2]], abs=2e-2)
        else:
            assert now.along_m == pytest.approx(one.along_m, abs=1e-6)


def test_nodes_that_a_revert_had_hidden_bring_back_what_joins_them_to_others(tmp_path, fleet):
    centre, sent = tmp_path / "centre.engram", tmp_path / "sent.engram"
    first, other = fleet["first"][0], fleet["other"][0]
    merged(centre, first, other)
    # A robot drives on in a download, so that its nodes hang on those of `first`.
    download(centre, sent, DownloadOptions())
    drive = frame_log(tmp_path / "drive.framelog", np.arange(8, 40, 0.8), name="r5", day=5)
    map_drive(sent, open_drive(drive), Settings(), RobotOptions(relocaliser="exhaustive"))
    (before,) = merged(centre, sent)
    with Map.open(centre, writes=True) as store:
        store.revert(1, author="tests")
    (report,) = merged(centre, first)
    with open_map(centre, None) as opened:
        assert report.components == opened.graph.components().max() + 1 == before.components
    assert report.taken
    assert not any("matched the fleet map" in note for note in report.notes)
    assert not any("not connected" in note for note in report.notes)
    assert_sound(centre)


def test_short_runs_that_only_the_robot_knows_how_to_place_are_looked_for_everywhere(
    tmp_path, fleet
):
    """By day it hung on what it had seen at night, which the centre knows nothing of."""
    near, look = np.arange(0, 24, 0.8), np.ones(30, np.int64)
    for start in (6, 16, 25):
        look[start : start + 5] = 0
    path = tmp_path / "robot.engram"
    robot_map(path, near, 1, name="r5", day=5)
    by_day = robot_map(path, near, look, name="r5", day=6, aside_m=0.2)
    centre = tmp_path / "centre.engram"
    merged(centre, fleet["first"][0])
    (report,) = merged(centre, path)
    night, *short = report.segments
    assert night.omitted == 0
    assert sum(one.taken + one.omitted for one in short) == len(by_day.saved)
    assert all(one.taken + one.omitted <= 5 for one in short)  # 4 m
    assert sum(one.omitted for one in short) == len(by_day.saved)
    assert report.components == 1


def test_what_a_withdrawn_fix_would_have_omitted_is_taken(fleet, tmp_path, monkeypatch):
    """The first two fixes stand on trial until the third contradicts them."""
    centre = Path(shutil.copy(fleet["first"][0], tmp_path / "centre.engram"))
    seen: list[int] = []
    plain = Localiser.localise

    def localise(self, live, *given):
        seen.append(live.stamp_ns)
        found = plain(self, live, *given)
        return replace(found, withdraws=tuple(seen[:2])) if len(seen) == 3 else found

    monkeypatch.setattr(Localiser, "localise", localise)
    monkeypatch.setattr(Localiser, "on_trial", property(lambda _: len(seen) < 4))
    (report,) = merged(centre, fleet["same"][0])
    with Map.open(centre) as store:
        stamps = {node.stamp_ns for node in store.load().nodes}
        assert set(seen[:2]) <= stamps
        assert not set(seen[2:]) & stamps
        assert report.taken == 2
    assert_sound(centre)


def test_fixes_on_trial_at_the_end_of_a_segment_neither_omit_nor_join(fleet, tmp_path, monkeypatch):
    centre = Path(shutil.copy(fleet["first"][0], tmp_path / "centre.engram"))
    with Map.open(centre) as store:
        before = store.node_count()
    monkeypatch.setattr(Localiser, "on_trial", property(lambda _: True))
    (report,) = merged(centre, fleet["same"][0])
    assert report.omitted == 0
    assert report.components == 2
    with open_map(centre, None) as opened:
        assert len(opened.graph) == before + report.taken
        apart = opened.graph.components()
        assert apart[:before].max() == 0
        assert set(apart[before:].tolist()) == {1}
    assert_sound(centre)
