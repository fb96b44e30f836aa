"""A ranking study end to end, and what studies share: folds, tasks, maps, matches."""

from __future__ import annotations

import csv
import os
import select
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lab.tests.evaluation.campaigns import LOOKS, few_options, write_campaign
from tests.builders import World, drive
from tests.maps import maps
from tests.sequences.test_framelog import write_ranked

from engram.errors import ConfigError, MapError, MapLockedError, SequenceError, WorkerError
from engram.frontend.matching import Match, MatcherConfig
from engram.graph.graph import ExperienceGraph
from engram.graph.model import NodeId, SessionId, node_id
from engram.localiser.attempts import Lanes
from engram.localiser.localisation import Localisation, LocalisationStatus
from engram.maps.map import open_map
from engram.monitor import QUIET
from engram.odometry.motion import Motion
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.framelog.reader import FrameLog
from engram_lab.studies import building, running
from engram_lab.studies.building import build_map, true_nodes
from engram_lab.studies.configurations import BY_TRUTH, EVERYTHING, UNLIMITED, Configuration, sweep
from engram_lab.studies.drives import (
    DriveSet,
    KeptMaps,
    TrueNodes,
    drives_of,
    open_campaign,
    seen_by,
    split,
)
from engram_lab.studies.fleet.plan import FleetOptions
from engram_lab.studies.in_force import check_logs
from engram_lab.studies.lockstep import ByTruth, MatchMemo, Placing, Situation, read_runs
from engram_lab.studies.plan import Task, alone_in, run_tasks
from engram_lab.studies.ranking_report import write_report
from engram_lab.studies.running import Plan, forget, make_plan, run
from engram_lab.truth import truth_path


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> DriveSet:
    return write_campaign(tmp_path_factory.mktemp("campaign"))


def results(plan: Plan, mode: str = "memo") -> dict:
    """Everything but times, by session and configuration."""
    found = {}
    for session in range(len(plan.drives.drives)):
        runs = read_runs(plan.runs_path(session, mode))
        if runs is None:
            continue
        for row, one in enumerate(runs.configurations):
            found[session, one] = tuple(
                getattr(runs, name)[row].tobytes()
                for name in ("matched", "attempts", "candidates", "succeeded", "offset_m")
            )
    return found


@pytest.fixture(scope="module")
def plan(campaign, tmp_path_factory) -> Plan:
    plan = make_plan(campaign, Settings(), few_options(), tmp_path_factory.mktemp("work"))
    run(plan)
    return plan


def test_every_session_is_localised_with_every_configuration(plan: Plan) -> None:
    assert {session for session, _ in results(plan)} == set(range(len(plan.drives.drives)))
    runs = read_runs(plan.runs_path(0, "memo"))
    assert runs.matched.shape == (len(runs.configurations), len(runs.step_m))
    # Look 0 is in every fold's training sessions: its drives are localised nearly everywhere.
    assert runs.matched[runs.configurations.index(Configuration("path-near", 2))].mean() > 0.9
    assert np.nanmax(runs.offset_m) < 0.5


@pytest.mark.long
def test_two_workers_and_one_give_the_same(campaign, plan: Plan, tmp_path: Path) -> None:
    other = make_plan(campaign, Settings(), few_options(), tmp_path)
    run(other, workers=2)
    assert results(other) == results(plan)


def test_held_out_sessions_are_not_in_the_map_and_leave_it_as_it_was(plan: Plan) -> None:
    for fold in plan.folds:
        held_out = {plan.drives.drives[number].session.id for number in fold.held_out}
        with open_map(plan.map_path(fold)) as opened:
            assert held_out.isdisjoint(opened.sessions)
            assert len(opened.sessions) == len(fold.training)
            assert len(opened.log()) == len(fold.training)


def test_what_is_memoised_is_what_a_robot_would_do_unguided(plan: Plan) -> None:
    # The live runs with guidance turned off make every match afresh, on threads, from the map.
    localiser = replace(plan.settings.localiser, guide_below_m=0.0)
    settings = replace(plan.settings, localiser=localiser)
    unguided = replace(plan, settings=settings, options=replace(plan.options, live_folds=2))
    for fold in unguided.folds:
        running._run_live(unguided, fold, fold.held_out[0])
    live, memo = results(unguided, "live"), results(plan)
    assert len(live) == 2 * 2
    assert all(memo[key] == value for key, value in live.items())


@pytest.mark.long
def test_logs_of_one_name_in_several_folders_are_several_drives(
    campaign, plan: Plan, tmp_path: Path
) -> None:
    logs = []
    for number, one in enumerate(campaign.drives):
        folder = tmp_path / f"monday{number}"
        folder.mkdir()
        logs.append(shutil.copy(one.path, folder / "log.framelog"))
        shutil.copy(truth_path(one.path), truth_path(folder / "log.framelog"))
    same = DriveSet(campaign.name, drives_of([Path(one) for one in logs]))
    other = make_plan(same, Settings(), few_options(), tmp_path / "work")
    run(other)
    assert results(other) == results(plan)


def test_truth_that_comes_later_voids_what_was_run_without(campaign, tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    shutil.copytree(campaign.drives[0].path.parent, folder)
    logs = [folder / one.path.name for one in campaign.drives]
    whole = DriveSet("tiny", drives_of(logs)).hash
    assert whole == campaign.hash
    truth = truth_path(logs[0])
    text = truth.read_text()
    truth.write_text(text + "# the same poses, told again\n")
    changed = DriveSet("tiny", drives_of(logs)).hash
    truth.unlink()
    assert len({whole, changed, DriveSet("tiny", drives_of(logs)).hash}) == 3


class _KilledError(Exception):
    pass


@pytest.mark.long
@pytest.mark.parametrize("moment", ["building", "running"])
def test_a_run_that_was_killed_goes_on_to_the_same_end(
    campaign, plan: Plan, tmp_path: Path, monkeypatch, moment: str
) -> None:
    other = make_plan(campaign, Settings(), few_options(), tmp_path)
    left = [3]

    def dying(function):
        def call(*args, **options):
            left[0] -= 1
            if left[0] < 0:
                raise _KilledError
            return function(*args, **options)

        return call

    with monkeypatch.context() as patch:
        if moment == "building":
            patch.setattr("engram_lab.studies.building.map_drive", dying(building.map_drive))
        else:
            patch.setattr(running, "_run_session", dying(running._run_session))
        with pytest.raises(_KilledError):
            run(other)
    assert len(results(other)) < len(results(plan))
    run(other)
    assert results(other) == results(plan)


def test_two_runs_do_not_work_in_one_folder(plan: Plan) -> None:
    with (
        alone_in(plan.work),
        pytest.raises(MapLockedError, match=r"process \d+ on .* evaluates there; wait"),
    ):
        run(plan)


def test_what_is_named_twice_is_run_once() -> None:
    options = replace(
        few_options(), policies=("path-near", "distance", "path-near"), lanes=(2, 1, 2)
    )
    assert options.policies == ("path-near", "distance")
    assert options.lanes == (2, 1)


def test_more_policies_later_cost_only_what_is_new(plan: Plan, tmp_path: Path) -> None:
    work = tmp_path / plan.work.name
    shutil.copytree(plan.work, work)
    options = replace(plan.options, policies=("distance", "path-near", "random"))
    more = replace(plan, options=options, work=work)
    before = {path: path.read_bytes() for path in work.glob("fold*.engram")}
    run(more)
    found = results(more)
    assert {key: found[key] for key in results(plan)} == results(plan)
    assert {one.policy for _, one in found} == {"distance", "path-near", "random"}
    assert all(path.read_bytes() == bytes_ for path, bytes_ in before.items())


@pytest.mark.long
def test_a_relocaliser_shares_maps_and_matches_but_not_results(
    campaign, plan: Plan, tmp_path: Path
) -> None:
    work = tmp_path / plan.work.name
    shutil.copytree(plan.work, work)
    options = replace(plan.options, relocaliser="fabmap")
    other = make_plan(campaign, Settings(), options, tmp_path)
    assert other.work == work
    maps = {path: path.read_bytes() for path in work.glob("fold*.engram")}
    before = results(replace(plan, work=work))
    run(other)
    assert {path: path.read_bytes() for path in work.glob("fold*.engram")} == maps
    assert results(replace(plan, work=work)) == before
    assert set(results(other)) == set(before)


@pytest.mark.long
def test_policies_are_run_again_in_the_folds_that_are_run(plan: Plan, tmp_path: Path) -> None:
    work = tmp_path / plan.work.name
    shutil.copytree(plan.work, work)
    one_fold = replace(plan, options=replace(plan.options, only_folds=(1,)), work=work)
    forget(one_fold, ["path-near"])
    left = results(one_fold)
    dropped = {(session, one.policy) for session, one in set(results(plan)) - set(left)}
    assert dropped == {(session, "path-near") for session in plan.folds[1].held_out}
    run(one_fold)
    assert results(one_fold) == results(plan)


@pytest.mark.long
def test_folds_may_be_run_one_after_another(campaign, plan: Plan, tmp_path: Path) -> None:
    first = make_plan(campaign, Settings(), few_options(only_folds=(1,)), tmp_path)
    run(first)
    held_out = {session for session, _ in results(first)}
    assert held_out == set(first.folds[1].held_out)
    assert write_report(tmp_path / "part", [first]).files
    run(make_plan(campaign, Settings(), few_options(), tmp_path))
    assert results(first) == results(plan)
    with pytest.raises(ConfigError, match="numbered from 0"):
        few_options(only_folds=(9,))


@pytest.mark.long
def test_a_report_has_every_table_and_figure(plan: Plan, tmp_path: Path) -> None:
    work = tmp_path / plan.work.name
    shutil.copytree(plan.work, work)
    options = replace(
        plan.options, policies=("distance", "path-near", "oracle"), map_sizes=True, live_folds=1
    )
    whole = replace(plan, options=options, work=work)
    run(whole)
    files = {path.name for path in write_report(tmp_path / "out", [whole]).files}
    assert {"summary.csv", "sessions.csv", "configuration.json", "report.md"} <= files
    assert {name.split("_")[0] for name in files if name.endswith(".png")} == {
        "fig09",
        "fig10",
        "fig11",
        "fig12",
        "fig13",
        "costs",
    }
    assert all((tmp_path / "out" / name).stat().st_size > 0 for name in files)
    with (tmp_path / "out" / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    wanted = "campaign policy lanes rounds T fold sessions frames p_gt_10m share_not_localised"
    wanted += " attempts_per_frame ms_per_frame false_successes median_error_m"
    assert set(wanted.split()) <= set(rows[0])
    pooled = {
        row["policy"]: float(row["share_not_localised"])
        for row in rows
        if (row["fold"], row["mode"], row["lanes"], row["map_sessions"]) == ("all", "memo", "2", "")
        and (row["T"], row["radius"], row["paths"]) == ("10", "search", "matched+saved")
    }
    assert set(pooled) == {"distance", "path-near", "oracle"}
    assert pooled["oracle"] <= min(pooled.values())
    # A fold's rows pool to the row of all folds, weighted by the way driven.
    by_fold = [
        row
        for row in rows
        if (row["policy"], row["mode"], row["lanes"], row["map_sessions"])
        == ("oracle", "memo", "2", "")
    ]
    whole_way = sum(float(row["driven_m"]) for row in by_fold if row["fold"] != "all")
    missed = sum(
        float(row["driven_m"]) * float(row["share_not_localised"])
        for row in by_fold
        if row["fold"] != "all"
    )
    assert missed / whole_way == pytest.approx(pooled["oracle"], abs=1e-5)
    assert all(row["ms_per_frame"] for row in rows if row["mode"] == "live")
    text = (tmp_path / "out" / "report.md").read_text()
    assert "`distance` ÷ `path-near`, Np = 2" in text


@pytest.mark.long
def test_logs_without_truth_are_localised_and_have_no_errors(tmp_path: Path) -> None:
    looks = (0, 0, 1, 0)
    bare = write_campaign(tmp_path / "logs", looks, truth=False)
    options = few_options(relocaliser=None, lanes=(2, UNLIMITED))
    plan = make_plan(bare, Settings(), options, tmp_path / "work")
    run(plan)
    write_report(tmp_path / "out", [plan])
    with (tmp_path / "out" / "summary.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["fold"] == "all"]
    assert all(row["median_error_m"] == row["false_successes"] == "" for row in rows)
    assert all(0 < float(row["share_not_localised"]) < 0.6 for row in rows if row["lanes"] == "2")
    page = (tmp_path / "out" / "report.md").read_text()
    assert "The truth of NAME.framelog is NAME.truth.txt next to it, in TUM format." in page


def test_a_drive_with_truth_among_others_without_is_localised(tmp_path: Path) -> None:
    """Where it is is known, but not from which node: it starts where it matches."""
    drives = write_campaign(tmp_path / "logs", (0, 0, 0))
    for one in drives.drives[1:]:
        truth_path(one.path).unlink()
    drives = DriveSet("some", drives_of([one.path for one in drives.drives]))
    options = few_options(policies=("distance",), lanes=(2,), folds=3, only_folds=(0, 1, 2, 1))
    plan = make_plan(drives, Settings(), options, tmp_path / "work")
    assert [one.number for one in plan.run_folds] == [0, 1, 2]
    run(plan)
    for session in range(3):
        runs = read_runs(plan.runs_path(session, "memo"))
        assert runs is not None
        assert runs.matched.mean() > 0.8


def test_bad_truth_is_told_before_anything_is_built(tmp_path: Path) -> None:
    drives = write_campaign(tmp_path / "logs", (0, 0))
    truth_path(drives.drives[1].path).write_text("1.0 2.0 three\n")
    with pytest.raises(SequenceError, match=r"001\.truth\.txt"):
        drives_of([one.path for one in drives.drives])


def test_settings_may_ask_for_fewer_landmarks_than_logs_keep(tmp_path: Path) -> None:
    few = replace(Settings(), frontend=replace(Settings().frontend, landmarks=4))
    ranked = DriveSet("ranked", drives_of([write_ranked(tmp_path / "a.framelog")]))
    seen = seen_by(ranked, few)
    counts = [
        [len(one.frame.landmarks) for one in log.drives[0].frames()] for log in (seen, ranked)
    ]
    wanted = [len(one.frame.landmarks) for one in FrameLog(ranked.drives[0].path, landmarks=4)]
    assert counts[0] == wanted != counts[1]
    check_logs(few, seen)
    with pytest.raises(ConfigError, match=r"frontend\.landmarks is 4"):
        check_logs(few, ranked)
    assert seen_by(ranked, Settings()) is ranked
    with pytest.raises(ConfigError, match="which come first"):
        seen_by(write_campaign(tmp_path / "logs", (0,)), few)


def test_a_study_may_take_the_first_drives_of_a_campaign(tmp_path: Path) -> None:
    with pytest.raises(SequenceError, match="2 of 2 sessions are not rendered"):
        open_campaign("hamlet", tmp_path, first=2)


def test_what_cannot_be_evaluated_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no ranking policy 'nearest'"):
        few_options(policies=("nearest",))
    with pytest.raises(ConfigError, match="lanes are"):
        few_options(lanes=())
    with pytest.raises(SequenceError, match=r"engram lab simulate hamlet --seed 2"):
        open_campaign("hamlet@2", tmp_path)
    with pytest.raises(ConfigError, match="must be a whole number"):
        open_campaign("hamlet@second", tmp_path)
    with pytest.raises(SequenceError, match="engram record"):
        drives_of([tmp_path / "images"])
    one = write_campaign(tmp_path / "logs", (0,)).drives[0]
    with pytest.raises(SequenceError, match="same drive"):
        drives_of([one.path, one.path])


@given(st.integers(2, 8), st.integers(0, 40), st.integers(0, 5))
def test_every_session_is_held_out_once_and_never_trained_on_then(folds, more, seed) -> None:
    sessions = folds + more
    parts = split(sessions, folds, seed)
    assert sorted(one for part in parts for one in part.held_out) == list(range(sessions))
    for part in parts:
        assert sorted((*part.training, *part.held_out)) == list(range(sessions))
        assert list(part.training) == sorted(part.training)
    sizes = [len(part.held_out) for part in parts]
    assert max(sizes) - min(sizes) <= 1


def test_the_seed_decides() -> None:
    assert split(20, 5, 1) == split(20, 5, 1)
    assert split(20, 5, 1) != split(20, 5, 2)


def test_too_few_sessions_are_refused() -> None:
    with pytest.raises(ConfigError, match="3 sessions into 5 folds"):
        split(3, 5)


def _write(path: Path) -> None:
    path.write_text("done")


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_worker_that_dies_is_said_in_one_line(tmp_path: Path) -> None:
    first = tmp_path / "first"
    tasks = [
        Task("first", partial(_write, first)),
        Task("second", _die, needs=("first",)),
    ]
    with pytest.raises(WorkerError, match=r"a worker of 2 died .* --workers"):
        run_tasks(tasks, 2, QUIET)
    assert first.read_text() == "done"


@pytest.mark.long
def test_workers_end_with_a_run_that_is_killed() -> None:
    """Left behind, they would write where the run that goes on writes."""
    program = "from lab.tests.evaluation.test_running import wait_for_ever; wait_for_ever()"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        workers = [os.pidfd_open(int(parent.stdout.readline())) for _ in range(2)]
        parent.kill()
    for worker in workers:
        ended, _, _ = select.select([worker], [], [], 60)
        os.close(worker)
        assert ended


def wait_for_ever() -> None:
    """In a process of its own: two workers that tell who they are and do not end."""
    run_tasks([Task("one", _tell_and_wait), Task("two", _tell_and_wait)], 2, QUIET)


def _tell_and_wait() -> None:
    os.write(1, f"{os.getpid()}\n".encode())
    signal.pause()


OPTIONS: RobotOptions = few_options().build


@pytest.fixture
def two_drives(tmp_path: Path) -> DriveSet:
    return write_campaign(tmp_path / "campaign", (0, 0))


class Hiding(Lanes):
    """Matches as a robot does, but for some nodes."""

    hidden = ()

    def match(self, live, live_id, node, guide):
        none = np.empty(0, np.int32)
        if node in self.hidden:
            return Match(None, None, 0, none, none)
        return super().match(live, live_id, node, guide)


class FakeMap:
    """Nodes of a real map, some of them cut off from the rest."""

    def __init__(self, graph: ExperienceGraph, cut_off: int) -> None:
        self.graph = self
        self.nodes = graph.nodes
        self._graph = graph
        self._cut_off = cut_off

    def index(self, node) -> int:
        return self._graph.index(node)

    def components(self) -> np.ndarray:
        return (np.arange(len(self.nodes)) == self._cut_off).astype(np.int32)


def test_a_drive_starts_where_the_map_hangs_together(two_drives: DriveSet, tmp_path: Path) -> None:
    build_map(tmp_path / "town.engram", two_drives.drives, Settings(), OPTIONS)
    truths = {one.session.id: one.truth() for one in two_drives.drives}
    with open_map(tmp_path / "town.engram") as opened:
        nodes = true_nodes(opened, two_drives.drives)
        alone = opened.graph.nodes[4].id
        there = nodes.pose(alone)
        assert there is not None
        plain = nodes.start(there)
        cut = TrueNodes(FakeMap(opened.graph, 4), truths).start(there)
    assert plain is not None
    assert plain.node == alone
    assert cut is not None
    assert cut.node != alone
    # The same place, seen from another node.
    pose = nodes.pose(cut.node)
    assert pose is not None
    np.testing.assert_allclose((pose @ cut.node_from_live).translation, there.translation)


def test_a_lost_robot_is_found_at_the_nearest_node_that_matches(
    two_drives: DriveSet, tmp_path: Path
) -> None:
    build_map(tmp_path / "town.engram", two_drives.drives[:1], Settings(), OPTIONS)
    drive = two_drives.drives[1]
    frames, truth = drive.frames(), drive.truth()
    live, motion = frames[3].frame, Motion(frames[3].odometry)
    lost = Localisation(live.stamp_ns, LocalisationStatus.LOST, 0, 0, 0.0, motion)
    with open_map(tmp_path / "town.engram") as opened:
        nodes = true_nodes(opened, two_drives.drives[:1])
        situation = Situation(opened, drive, frames, None, nodes, truth)
        config = Settings().localiser
        matcher = Hiding(opened.frames, config.matcher)
        relocaliser = ByTruth(situation, matcher, config.acceptance)
        there = truth.at(live.stamp_ns)
        matcher.hidden = [one.node for one in nodes.seen_from(there, 8.0)][:2]
        placing, other = Placing(situation, relocaliser), Placing(situation)
        assert placing.hint(live, motion) is None
        for one in (placing, other):
            one.keep(live, lost)
        hint = placing.hint(live, motion)
        assert hint is not None
        assert hint.position is not None
        assert hint.agreed == 1
        assert hint.position.node == nodes.seen_from(there, 8.0)[2].node
        np.testing.assert_allclose(
            (nodes.pose(hint.position.node) @ hint.position.node_from_live).matrix(),
            there.matrix(),
            atol=1e-12,
        )
        assert other.hint(live, motion) is None
        placing.keep(live, replace(lost, status=LocalisationStatus.LOCALISED))
        assert placing.hint(live, motion) is None
        matcher.hidden = [one.id for one in opened.graph.nodes]
        assert ByTruth(situation, matcher, config.acceptance).find(live) is None


def test_truth_finds_the_lost_of_ranking_studies_alone(tmp_path: Path) -> None:
    campaign = write_campaign(tmp_path / "campaign", LOOKS[:4], truth=False)
    plan = make_plan(campaign, Settings(), few_options(relocaliser=BY_TRUTH), tmp_path)
    with pytest.raises(ConfigError, match="its truth is not known"):
        run(plan)
    with pytest.raises(ConfigError, match="do not know the truth"):
        FleetOptions(relocaliser=BY_TRUTH)


def test_every_candidate_is_attempted_only_where_something_asks_for_it() -> None:
    assert EVERYTHING not in sweep(("distance", "path-near"), (1, 2), (1,))
    assert EVERYTHING in sweep(("distance", "oracle"), (1, 2), (1,))
    assert EVERYTHING in sweep(("path-near",), (2, UNLIMITED), (1,))


@pytest.fixture
def town(tmp_path: Path) -> Path:
    """A map of two drives of five nodes."""
    path = tmp_path / "town.engram"
    with open_map(path, create=True) as store, store.writing():
        for number in range(2):
            drive = maps.session(start_ns=1_000 + number * 10**12)
            writer = maps.begin(store, drive)
            maps.write_drive(writer)
            writer.commit()
    return path


def test_a_map_that_was_asked_for_before_is_the_same_one(town: Path) -> None:
    kept = KeptMaps(files=1)
    newest, first = kept.open(town), kept.open(town, at=1)
    assert (len(newest.graph), len(first.graph)) == (10, 5)
    assert kept.open(town) is newest
    assert kept.open(town, at=1) is first
    kept.close()
    assert kept.open(town) is not newest
    kept.close()


def test_the_file_that_was_asked_for_longest_ago_is_closed(town: Path) -> None:
    others = [town.with_name(f"other-{number}.engram") for number in range(2)]
    for other in others:
        shutil.copyfile(town, other)
    kept = KeptMaps(files=2)
    opened = kept.open(town)
    between = kept.open(others[0])
    assert kept.open(town) is opened
    kept.open(others[1])
    assert kept.open(town) is opened
    assert kept.open(others[0]) is not between
    kept.close()


def test_a_map_that_was_made_again_is_opened_again(town: Path) -> None:
    kept = KeptMaps(files=2)
    opened = kept.open(town)
    draft = town.with_name("draft.engram")
    shutil.copyfile(town, draft)
    draft.replace(town)
    assert kept.open(town) is not opened
    kept.close()


def test_what_is_no_map_is_refused_again_and_again(tmp_path: Path) -> None:
    path = tmp_path / "town.engram"
    path.write_bytes(b"no map")
    kept = KeptMaps(files=1)
    for _ in range(2):
        with pytest.raises(MapError):
            kept.open(path)
    kept.close()


WORLD = World(20.0)
CONFIG = MatcherConfig()
LIVE = SessionId(UUID(int=7))


class Frames:
    """Frames in memory, counting how often they are asked for."""

    def __init__(self) -> None:
        self.asked = 0
        seen = [*drive(WORLD, np.arange(0.0, 6.0, 2.0)), *drive(WORLD, np.arange(0.0, 6.0, 2.0), 1)]
        self.nodes = {NodeId(UUID(int=k)): one.frame for k, one in enumerate(seen)}

    def frame(self, node):
        self.asked += 1
        return self.nodes[node]

    def prefetch(self, nodes) -> None:
        raise AssertionError("a memo reads nothing ahead")


@pytest.fixture
def frames() -> Frames:
    return Frames()


def live_frames():
    return [one.frame for one in drive(WORLD, np.arange(0.3, 4.0, 1.5), seed=3, start_ns=10**15)]


def memo_of(frames: Frames, path: Path, matcher_hash: str = "a") -> MatchMemo:
    return MatchMemo(Lanes(frames, CONFIG), path, matcher_hash)


def everything(matcher, frames: Frames) -> list:
    return [
        matcher.match(live, node_id(LIVE, live.stamp_ns), node, None)
        for live in live_frames()
        for node in frames.nodes
    ]


def assert_same(found, wanted) -> None:
    assert len(found) == len(wanted)
    for one, other in zip(found, wanted, strict=True):
        assert one.inliers == other.inliers
        assert (one.reference_from_live is None) == (other.reference_from_live is None)
        if other.reference_from_live is not None:
            assert (one.reference_from_live.matrix() == other.reference_from_live.matrix()).all()
            assert (one.covariance == other.covariance).all()


def test_what_is_kept_is_to_the_bit_what_would_be_made(frames: Frames, tmp_path: Path) -> None:
    wanted = everything(Lanes(frames, CONFIG), frames)
    assert any(one.inliers > 20 for one in wanted)
    assert any(one.inliers == 0 for one in wanted)
    memo = memo_of(frames, tmp_path / "memo.npz")
    assert_same(everything(memo, frames), wanted)
    memo.save()
    frames.asked = 0
    again = memo_of(frames, tmp_path / "memo.npz")
    assert again.known == len(wanted)
    assert_same(everything(again, frames), wanted)
    assert frames.asked == again.made == 0


def test_an_attempt_is_made_once(frames: Frames, tmp_path: Path) -> None:
    memo = memo_of(frames, tmp_path / "memo.npz")
    everything(memo, frames)
    made = memo.made
    everything(memo, frames)
    assert memo.made == made == len(frames.nodes) * len(live_frames())


@pytest.mark.parametrize("damage", ["other matcher", "cut short", "no archive"])
def test_a_memo_that_does_not_fit_counts_as_empty(
    frames: Frames, tmp_path: Path, damage: str
) -> None:
    path = tmp_path / "memo.npz"
    memo = memo_of(frames, path)
    everything(memo, frames)
    memo.save()
    if damage == "cut short":
        path.write_bytes(path.read_bytes()[:-100])
    elif damage == "no archive":
        path.write_bytes(b"nothing of the kind")
    again = memo_of(frames, path, "b" if damage == "other matcher" else "a")
    assert again.known == 0
    assert_same(everything(again, frames), everything(Lanes(frames, CONFIG), frames))


def test_the_spread_of_inliers_is_known_too(frames: Frames, tmp_path: Path) -> None:
    matcher, memo = Lanes(frames, CONFIG), memo_of(frames, tmp_path / "memo.npz")
    live, node = live_frames()[0], next(iter(frames.nodes))
    live_id = node_id(LIVE, live.stamp_ns)
    match = matcher.match(live, live_id, node, None)
    kept = memo.match(live, live_id, node, None)
    spread = matcher.spread(live, live_id, node, match)
    assert memo.spread(live, live_id, node, kept) == spread
    assert min(spread.image, spread.height) > 0
