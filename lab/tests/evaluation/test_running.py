"""Cross-validation end to end, on tiny synthetic campaigns."""

import csv
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lab.tests.evaluation.campaigns import few_options, write_campaign

from engram.errors import ConfigError, MapLockedError, SequenceError
from engram.maps.map import open_map
from engram.robot.settings import Settings
from engram_lab.studies import building, running
from engram_lab.studies.configurations import UNLIMITED, Configuration
from engram_lab.studies.drives import DriveSet, drives_of, open_campaign
from engram_lab.studies.lockstep import read_runs
from engram_lab.studies.pages import alone_in
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


def test_logs_of_one_name_in_several_folders_are_several_drives(
    campaign, plan: Plan, tmp_path: Path
) -> None:
    logs = []
    for number, drive in enumerate(campaign.drives):
        folder = tmp_path / f"monday{number}"
        folder.mkdir()
        logs.append(shutil.copy(drive.path, folder / "log.framelog"))
        shutil.copy(truth_path(drive.path), truth_path(folder / "log.framelog"))
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
