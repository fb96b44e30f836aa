"""Injected faults do to a drive what they say; questions count, and what they made is kept."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from uuid import UUID

import cv2
import numpy as np
import pytest
from lab.tests.evaluation.campaigns import write_campaign
from numpy.typing import NDArray
from typer.testing import CliRunner

from engram.errors import ConfigError, MapCorruptError
from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId
from engram.maps.map import Map
from engram.robot.settings import Settings
from engram_lab.accuracy import Count, Fix, events
from engram_lab.cli import lab
from engram_lab.studies.faults import questions
from engram_lab.studies.faults.clips import (
    DOCTORED,
    JUDGING,
    MAPPED,
    REVERSED,
    SETTING,
    Clip,
    ClipDrive,
)
from engram_lab.studies.faults.injected import (
    FAULTS,
    blackout,
    brightened,
    fixed_pattern,
    frozen,
    kidnapped,
    on_both,
    reaching_in,
    stalled,
    undisturbed,
    wrong_stamps,
)
from engram_lab.studies.faults.questions import MOUNTED, MountedSequence
from engram_lab.studies.faults.staging import (
    KINDS,
    MADE_BY,
    REVERSE,
    TURNED,
    Place,
    Scene,
    Trial,
    TrialFile,
    damaged,
    drawn,
    mapped_by,
    read_trials,
    turned_round,
)
from engram_lab.studies.faults.study import RealPlan, map_on, page, real_plans, run_trial
from engram_lab.studies.pages import faults, faults_by_kind
from engram_lab.studies.streets import (
    Kind,
    Street,
    Try,
    campaign_of,
    longer_trial_town,
    map_path,
    mapping_settings,
    trial_town,
)
from engram_lab.town.session import SimulatedSequence

CAMERA = StereoCamera(60.0, 60.0, 47.5, 31.5, 0.2, 96, 64)


@pytest.fixture
def pairs() -> list[StereoPair]:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (40, 2, 64, 96), dtype=np.uint8)
    return [StereoPair(k * 100_000_000, one[0], one[1], CAMERA) for k, one in enumerate(images)]


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_begins_at_its_start_and_changes_something_then(pairs, name: str) -> None:
    fault = FAULTS[name]
    assert fault.weakest <= fault.strongest
    shown = fault.apply(pairs, fault.strongest, 10, np.random.default_rng(1))
    for number, one in enumerate(shown[: 0 if fault.from_the_first else 10]):
        assert one.frame == number
        assert one.pair is pairs[number]
    assert [id(one.pair) for one in shown] != [id(pair) for pair in pairs]
    assert all(one.pair.left.dtype == np.uint8 for one in shown)
    assert all(one.pair.left.shape == (64, 96) for one in shown)


@pytest.mark.parametrize("side", ["bottom", "top", "left", "right"])
def test_a_fixed_pattern_keeps_its_pixels_in_every_frame(pairs, side: str) -> None:
    rng = np.random.default_rng(1)
    shown = [one.pair for one in fixed_pattern(pairs, 0.25, 10, rng, side, 4.0, 1.0)]
    same = np.all([one.left == shown[0].left for one in shown], axis=0)
    assert same.mean() == pytest.approx(0.25, abs=0.02)
    shift = round(CAMERA.focal_baseline / 4.0)
    covered = reaching_in(64, 96, side, 0.25)
    both = covered[:, shift:] & covered[:, :-shift]
    assert (shown[0].left[:, shift:] == shown[0].right[:, :-shift])[both].all()


def test_wrong_stamps_are_a_few_and_the_others_stay(pairs) -> None:
    shown = wrong_stamps(pairs, 60.0, 10, np.random.default_rng(1))
    wrong = [k for k, one in enumerate(shown) if one.pair.stamp_ns != pairs[k].stamp_ns]
    assert wrong == list(range(10, 10 + len(wrong)))
    assert 1 <= len(wrong) <= 3


def test_a_stall_leaves_out_the_frames_of_its_time(pairs) -> None:
    shown = stalled(pairs, 1.0, 10, np.random.default_rng(1))
    assert [one.frame for one in shown] == [*range(10), *range(20, 40)]


def test_a_frozen_stream_shows_the_image_before_it(pairs) -> None:
    shown = frozen(pairs, 3, 10, np.random.default_rng(1))
    assert all(shown[k].pair.left is pairs[9].left for k in (10, 11, 12))
    assert shown[13].pair is pairs[13]
    assert shown[11].pair.stamp_ns == pairs[11].stamp_ns


def test_a_blackout_ends(pairs) -> None:
    shown = blackout(pairs, 5, 10, np.random.default_rng(1))
    assert [int(one.pair.left.max()) == 0 for one in shown] == [10 <= k < 15 for k in range(40)]


def test_a_kidnapped_robot_is_elsewhere_and_its_stamps_go_on(pairs) -> None:
    shown = kidnapped(pairs, 12, 10, np.random.default_rng(1))
    assert shown[10].frame == 22
    assert [one.pair.stamp_ns for one in shown] == [k * 100_000_000 for k in range(len(shown))]


def test_trials_are_drawn_from_their_number_and_no_clip_of_the_limits_is_judged() -> None:
    plans = [*JUDGING, *REVERSED]
    first, again = (drawn(7, plans) for _ in range(2))
    assert first is not None
    assert again is not None
    assert first[:2] == again[:2]
    found = [drawn(number, plans) for number in range(len(KINDS))]
    assert {one[0] for one in found if one} == set(KINDS)
    assert not any(one[1].mapped for one in found if one)
    assert {one[0] for one in found if one and one[1].reverse} == {REVERSE, TURNED}
    assert drawn(KINDS.index(TURNED), JUDGING) is None
    assert not {plan.town for plan in SETTING} & {plan.town for plan in [*JUDGING, *REVERSED]}


def test_each_judged_town_is_driven_once_against_its_map() -> None:
    assert [plan.town for plan in REVERSED] == list(dict.fromkeys(plan.town for plan in JUDGING))
    assert {plan.session for plan in REVERSED}.isdisjoint({MAPPED})


def test_the_doctor_is_judged_on_twenty_drives_of_each_rig_in_other_towns() -> None:
    drives = Counter(plan.rig for plan in DOCTORED)
    assert set(drives.values()) == {20}
    assert set(drives) == {plan.rig for plan in JUDGING}
    for rig in drives:
        assert len({plan.session for plan in DOCTORED if plan.rig == rig}) == 20
    others = {plan.town for plan in [*SETTING, *JUDGING, *REVERSED]}
    assert others.isdisjoint(plan.town for plan in DOCTORED)


def test_results_are_read_as_far_as_they_are_whole_and_counted(tmp_path: Path) -> None:
    trials = [
        Trial(0, "stall", "a", 15, 0.5, 50, 40, expected=44, lost=5, again=0, driven_m=60.0),
        Trial(1, "stall", "a", 15, 3.0, frames=50, fixes=30, false=4, events=1, worst_m=7.5),
        Trial(
            2, "none", "kitti-06-there", 15, 0.0, frames=50, fixes=50, again=1,
            nodes=3, edges=9, joined=2, map_refused=["dark"],
        ),
    ]  # fmt: skip
    file = tmp_path / "trials.jsonl"
    file.write_text("\n".join(json.dumps(asdict(one)) for one in trials) + '\n{"number": 3, "f')
    assert read_trials(file) == trials
    rows = page(trials).splitlines()
    assert rows[0].endswith("1 false events, largest error claimed 7.50 m")
    assert "| all on real clips |  | 1 | 50 | 50 | – | 0 | 0 | 0.00 | 1, 1 | 0 | 0 |" in rows
    assert "| all |  | 3 | 150 | 120 | 5 of 44 | 4 | 1 | 7.50 | 0, 1 | 1 | 0 |" in rows
    assert rows[-1] == "| all |  | 1 | 1 | 3 | 9 | 2 | 0 | 0 | 0.00 |"


def test_blocks_of_a_page_sum_the_strengths_of_each_fault(tmp_path: Path) -> None:
    common = {"clip": "a", "start": 15, "driven_m": 250.0, "nodes": 3, "made_by": MADE_BY}
    trials = [
        Trial(0, "none", strength=0.0, fixes=50, expected=50, worst_m=0.1, **common),
        Trial(1, "stall", strength=0.5, fixes=40, expected=44, lost=4, worst_m=0.3, **common),
        Trial(
            2, "stall", strength=3.0, fixes=30, expected=40, lost=10, worst_m=0.2, joined=2,
            map_refused=["gap"], **common,
        ),
        Trial(3, "dropped frames", strength=0.1, fixes=50, expected=50, **common),
    ]  # fmt: skip
    (tmp_path / "faults").mkdir()
    (tmp_path / "faults/faults.md").write_text(page(trials), encoding="utf-8")
    told = " ".join(faults(tmp_path))
    assert told.startswith("In 4 short drives with one of 2 faults injected")
    assert "false fixes occur 0 times, the worst 0.30 m off" in told
    rows = list(faults_by_kind(tmp_path))[2:]
    assert rows == ["| stall | 2 | 17 % | 0 | 0.30 | 1 | 2 |"]


def test_a_file_of_trials_goes_on_after_a_line_that_a_killed_run_left(tmp_path: Path) -> None:
    path, rows = tmp_path / "faults/trials.jsonl", [Trial(k, "stall", "a", 15, 0.5) for k in (0, 1)]
    for row in rows:
        row.made_by = MADE_BY
    TrialFile(path).add(rows[0])
    with path.open("a") as out:
        out.write('{"number": 1, "fau')
    made = TrialFile(path)
    assert made.numbers == {0}
    made.add(rows[1])
    assert read_trials(path) == rows


def test_trials_of_other_versions_are_read_but_not_added_to(tmp_path: Path) -> None:
    path = tmp_path / "trials.jsonl"
    old = {"number": 0, "fault": "stall", "clip": "a", "start": 15, "strength": 0.5}
    path.write_text(json.dumps(old) + "\n")
    assert page(read_trials(path)).startswith("1 trials of earlier versions")
    with pytest.raises(ConfigError, match="name another file with --work"):
        TrialFile(path)


def test_a_map_without_a_far_place_tells_no_robot_a_wrong_one() -> None:
    """Clips of a wide camera are short: all nodes may lie within 15 m of the robot."""
    here, rng = SE3.identity(), np.random.default_rng(1)
    place = Place.__new__(Place)
    nodes = {NodeId(UUID(int=k)): here for k in range(1, 4)}
    object.__setattr__(place, "world_from_node", nodes)
    assert place.wrong_hint(here, 1.0, rng) is None
    nodes[NodeId(UUID(int=9))] = SE3.exp([0, 0, 15.5, 0, 0, 0])
    hint = place.wrong_hint(here, 1.0, rng)
    assert hint is not None
    assert hint.node == NodeId(UUID(int=9))
    assert hint.sigma_m == pytest.approx(1.0)


def moved(pairs: list[StereoPair], steps_m: list[float]) -> Clip:
    return Clip(JUDGING[1], pairs, [SE3.exp([0, 0, step, 0, 0, 0]) for step in steps_m])


def test_a_robot_that_is_turned_round_drives_back_from_where_it_was(pairs) -> None:
    there = moved(pairs, [float(k) for k in range(40)])
    back = moved(pairs, [45.0 - k for k in range(40)])
    turned = turned_round(there, back, 20)
    assert [pose.translation[2] for pose in turned.world_from_cam[18:23]] == [18, 19, 19, 18, 17]
    assert [pair.stamp_ns for pair in turned.pairs] == [k * 100_000_000 for k in range(34)]
    assert turned.pairs[20].left is back.pairs[26].left


def test_a_drive_leaves_out_what_a_reader_would(pairs) -> None:
    drive = ClipDrive(JUDGING[1], [pairs[0], pairs[2], pairs[1], pairs[2], pairs[3]])
    assert [one.stamp_ns for one in drive] == [0, 200_000_000, 300_000_000]
    assert (len(drive), drive.skipped) == (3, 2)


@pytest.fixture(scope="module")
def clip() -> Clip:
    """Twelve frames of a drive towards a textured wall, from 12 to 7.6 m."""
    camera = StereoCamera(300.0, 300.0, 159.5, 119.5, 0.4, 320, 240)
    noise = np.random.default_rng(0).integers(0, 256, (150, 250), dtype=np.uint8)
    wall = cv2.resize(noise, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)

    def view(x_m: float, away_m: float) -> NDArray[np.uint8]:
        zoom = 9.0 / away_m
        x_px, y_px = 159.5 - 300 * x_m / away_m - zoom * 500, 119.5 - zoom * 300
        wall_to_view = np.array([[zoom, 0, x_px], [0, zoom, y_px]])
        return np.asarray(cv2.warpAffine(wall, wall_to_view, (320, 240)), np.uint8)

    steps_m = [0.4 * k for k in range(12)]
    pairs = [
        StereoPair(k * 100_000_000, view(0.0, 12.0 - step), view(0.4, 12.0 - step), camera)
        for k, step in enumerate(steps_m)
    ]
    return moved(pairs, steps_m)


@contextmanager
def mapped(clip: Clip, frames: int, path: Path) -> Iterator[Place]:
    """The first frames of a clip, mapped."""
    place = mapped_by(Clip(clip.plan, clip.pairs[:frames], clip.world_from_cam[:frames]), path)
    yield place
    place.opened.close()


def test_damaged_landmarks_are_met_and_no_place_is_claimed_by_them(
    clip: Clip, tmp_path: Path
) -> None:
    with mapped(clip, 4, tmp_path / "own.engram") as own:
        spoilt = damaged(own, tmp_path / "damaged.engram", 0.5, np.random.default_rng(0))
    unreadable = 0
    for node in own.world_from_node:
        try:
            spoilt.opened.frames.frame(node)
        except MapCorruptError:
            unreadable += 1
    assert (unreadable, len(own.world_from_node)) == (1, 2)
    scene = Scene(clip, spoilt, 0, 0.5, undisturbed(clip.pairs[:4]))
    trial = run_trial(0, "damaged landmarks", scene, frozenset(range(3)))
    spoilt.opened.close()
    assert trial.fixes > 0
    assert (trial.false, trial.expected, trial.lost) == (0, 3, 0)


def test_a_drive_is_mapped_on_into_a_copy_and_wrong_edges_are_counted(
    clip: Clip, tmp_path: Path
) -> None:
    bright = [on_both(pair, lambda image: brightened(image, 3.0)) for pair in clip.pairs]
    later = [replace(pair, stamp_ns=pair.stamp_ns + 10**12) for pair in bright]
    live = Clip(clip.plan, later, clip.world_from_cam)
    trial, out = Trial(0, "none", "a", 0, 0.0), tmp_path / "mapped.engram"
    with mapped(clip, 4, tmp_path / "own.engram") as own:
        map_on(trial, Scene(live, own, 0, 0.0, undisturbed(later)), out)
        assert trial.nodes
        assert trial.edges
        assert (trial.joined, trial.joined_odometry, trial.map_refused) == (0, 0, [])
        away = SE3.exp([9, 0, 0, 0, 0, 0])
        nodes = {node: away @ pose for node, pose in own.world_from_node.items()}
        scene = Scene(live, replace(own, world_from_node=nodes), 0, 0.0, undisturbed(later))
        map_on(trial, scene, out)
        assert trial.joined > 0
        assert trial.worst_edge_m == pytest.approx(9, abs=0.1)
    with Map.open(own.path) as unchanged:
        assert len(unchanged.graph) == len(own.world_from_node)


def test_without_real_data_there_are_no_real_clips(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ENGRAM_DATA", str(tmp_path))
    assert real_plans() == []
    monkeypatch.delenv("ENGRAM_DATA")
    assert real_plans() == []


@pytest.mark.data
def test_a_real_room_is_mapped_by_one_part_and_driven_in_another(data_dir: Path) -> None:
    first, live = (RealPlan("v1-01", part, data_dir).read() for part in ("mapped", "there"))
    seen = {pair.left.tobytes() for pair in first.pairs}
    assert len(live) == 63
    assert not seen & {pair.left.tobytes() for pair in live.pairs}
    assert all(a.stamp_ns < b.stamp_ns for a, b in pairwise(live.pairs))
    assert np.array_equal(live.pairs[0].left, live.pairs[-1].left)


def along(*metres: float) -> list[SE3]:
    return [SE3(np.eye(3), np.array([0.0, 0.0, at])) for at in metres]


@pytest.mark.parametrize(
    ("at_m", "count"),
    [((), 0), ((5.0,), 1), ((5.0, 24.0, 43.0), 1), ((5.0, 25.5), 2), ((0.0, 1.0, 90.0, 91.0), 2)],
)
def test_false_fixes_less_than_20_m_apart_are_one_event(at_m, count) -> None:
    assert events(along(*at_m)) == count


def test_a_robot_is_counted_and_counts_add_up() -> None:
    fixes = [Fix(0, 0.1, False), Fix(2, 5.0, True, 8.0), Fix(3, 0.6, False)]
    one = Count.of(fixes, along(0, 1, 2, 3), after=1)
    assert (one.frames, one.metres, one.fixes, one.right) == (4, 3.0, 3, 2)
    assert (one.off, one.false, one.sure, one.hurt, one.events) == (2, 1, 1, 1, 1)
    assert (one.worst_m, one.again) == (5.0, (2,))
    never = Count.of(fixes[:1], along(0, 1), after=1)
    both = one + never
    assert (both.robots, both.frames, both.worst_m, both.again) == (2, 6, 5.0, (2,))


def test_without_an_event_the_bound_is_three_over_the_distance() -> None:
    """−ln 0.05 = 2.996: the textbook's rule of three."""
    bound = {
        one.name: one.value for one in questions.figures_of("a", Count(robots=2, metres=100e3))
    }["  their upper bound, 95 %"]
    assert bound == pytest.approx(2.9957, abs=1e-3)


def test_paired_shares_have_an_interval_over_the_drives() -> None:
    found = {one.name: one.value for one in questions.paired("a", [0.10, 0.06], [0.04, 0.02])}
    assert found["a: missed"] == pytest.approx(8.0)
    assert found["  more"] == pytest.approx(-5.0)
    assert (found["  from"], found["  to"]) == (pytest.approx(-6.0), pytest.approx(-4.0))


def test_what_a_table_holds_is_not_made_again_after_a_kill(tmp_path) -> None:
    asked = questions.Asked(Settings(), tmp_path)
    made = Count(robots=1, false=2, again=(3,))
    questions.Table("hints", asked).add("cold", "a", lambda: made)
    (file,) = tmp_path.iterdir()
    file.write_text(file.read_text() + '{"key": "cold: b", "cou')
    again = questions.Table("hints", asked)
    assert again.add("cold", "a", lambda: 1 / 0) == made
    again.add("cold", "b", lambda: made)
    values = {one.name: one.value for one in again.figures()}
    assert values["cold: robots"] == values["all: robots"] == 2
    assert values["  false"] == 4


def test_maps_are_of_distinct_drives_and_drawn_again_alike() -> None:
    drawn = questions.drawn_maps(10, 6)
    assert drawn == questions.drawn_maps(10, 6)
    assert all(len(set(one)) == 3 and list(one) == sorted(one) for one in drawn)
    assert len(set(drawn)) == len(drawn)


def test_settings_of_localising_change_no_map_and_others_do() -> None:
    town, usual = trial_town(401), Settings()
    lost = usual.localiser.__class__(search_radius_m=9.0)
    robots = Settings(localiser=lost)
    assert map_path(town, [0], robots) == map_path(town, [0], usual)
    assert mapping_settings(robots) == usual
    mapper = usual.mapper.__class__(sure_inliers=0)
    assert map_path(town, [0], Settings(mapper=mapper)) != map_path(town, [0], usual)


def test_a_longer_trial_town_begins_with_the_shorter_one() -> None:
    short, longer = trial_town(401), longer_trial_town(401)
    assert longer.sessions[: len(short.sessions)] == short.sessions
    assert [one.number for one in longer.sessions] == list(range(15))
    assert len({one.seed for one in longer.sessions}) == 15
    assert [one.reverse for one in longer.sessions] == [False] * 12 + [True] * 3
    assert campaign_of("401") == longer
    assert campaign_of("oxford@2").seed == 2


def test_a_mounted_camera_stands_higher_and_aside_and_looks_down() -> None:
    town = longer_trial_town(401)
    usual, other = SimulatedSequence(town, 6), MountedSequence(town, 6, MOUNTED)
    for a, b in zip(usual.truth().world_from_cam, other.truth().world_from_cam, strict=True):
        np.testing.assert_allclose((a.inverse() @ b).matrix(), MOUNTED.matrix(), atol=1e-9)
    before, after = usual.drive.poses[9].world_from_cam, other.drive.poses[9].world_from_cam
    assert after.translation[2] - before.translation[2] == pytest.approx(0.5, abs=0.03)
    down = np.rad2deg(np.arcsin(before.matrix()[2, 2]) - np.arcsin(after.matrix()[2, 2]))
    assert down == pytest.approx(10.0, abs=0.1)
    assert other.camera.id != usual.camera.id


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory):
    """A road of 24 m: two drives of one look, and one of another."""
    return write_campaign(tmp_path_factory.mktemp("campaign"), [0, 0, 1]).drives


@pytest.mark.parametrize("live", [1, 2])
def test_a_known_look_is_found_when_switched_on_and_an_unknown_one_cannot_be(
    drives, live, tmp_path
) -> None:
    there = Street(tmp_path / "map.engram", drives[:1], drives[live], Settings())
    starts = questions.first_frames(there, 5)
    for first in starts:
        one = questions.switched_on(there, first)
        if live == 1:
            assert (one.fixes, one.false) == (1, 0)
        else:
            assert one.fixes == 0
            assert questions.could_be_found(there, first, one.frames).robots == 0
    assert questions.could_be_found(there, starts[0], 2).robots == (live == 1)
    undisturbed = there.count(Try(Kind.UNDISTURBED))
    assert (undisturbed.right > 0, undisturbed.false) == (live == 1, 0)
    there.close()


def test_the_study_lists_its_questions_and_asks_one(tmp_path, monkeypatch) -> None:
    def asks(asked: questions.Asked):
        yield questions.Figure(
            f"towns {asked.towns}", asked.settings.localiser.search_radius_m, "m"
        )

    run = CliRunner().invoke
    wrong = run(lab, ["evaluate", "faults", "--only", "hint"])
    assert "hints" in str(wrong.exception)
    monkeypatch.setitem(questions.QUESTIONS, "hints", asks)
    given = ["evaluate", "faults", "--only", "hints", "--towns", "7,8", "--json"]
    given += ["--set", "localiser.search_radius_m=9", "--work", str(tmp_path)]
    answer = run(lab, given)
    assert json.loads(answer.stdout) == {
        "hints": [{"name": "towns (7, 8)", "value": 9.0, "unit": "m"}]
    }
