"""The fleet study end to end, on a tiny synthetic campaign."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lab.tests.evaluation.campaigns import write_campaign

from engram.errors import ConfigError, InputError
from engram.maps.map import Map, open_map
from engram.monitor import QUIET, Monitor
from engram.robot.settings import RobotOptions, Settings
from engram_lab.studies.drives import DriveSet
from engram_lab.studies.fleet import steps
from engram_lab.studies.fleet.experiments import fleet_tasks, pair_merges
from engram_lab.studies.fleet.plan import (
    FleetOptions,
    FleetPlan,
    Protocol,
    make_fleet_plan,
    read_download,
)
from engram_lab.studies.fleet.report import ArmResult, write_fleet_report
from engram_lab.studies.plan import run_tasks

pytestmark = pytest.mark.long

OPTIONS = FleetOptions(
    arms=("A",),
    folds=2,
    groups=2,
    more_groups=(),
    order_groups=2,
    tried=1,
    relocaliser="exhaustive",
)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> DriveSet:
    folder = tmp_path_factory.mktemp("campaign")
    return write_campaign(folder, (0, 1) * 4, road=np.arange(0.0, 9.0, 0.9))


def run(plan: FleetPlan, workers: int = 1) -> None:
    run_tasks(fleet_tasks(plan), workers, QUIET)


@pytest.fixture(scope="module")
def plan(campaign, tmp_path_factory) -> FleetPlan:
    plan = make_fleet_plan(campaign, Settings(), OPTIONS, tmp_path_factory.mktemp("work"))
    run(plan)
    return plan


@pytest.fixture(scope="module")
def report(plan, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("out")
    write_fleet_report(out, [plan])
    return out


def rows(report: Path, name: str = "summary.csv") -> list[dict[str, str]]:
    with (report / name).open() as file:
        return list(csv.DictReader(file))


def test_every_experiment_arm_and_fold_has_its_rows(report: Path) -> None:
    found = {(row["experiment"], row["fold"]) for row in rows(report)}
    every_fold = {(one, fold) for one in ("7", "8", "9") for fold in ("0", "1", "all")}
    assert found == every_fold | {("10", "0")}


def test_every_mean_over_drives_can_be_made_again(report: Path) -> None:
    """Of the rows of single drives, weighted by their lengths."""
    drives = rows(report, "sessions.csv")
    means = [row for row in rows(report) if row["fold"] != "all" and row["sessions"]]
    held_out = [row for row in means if "foray" not in row["map"]]
    assert {row["experiment"] for row in held_out} == {"7", "8", "9", "10"}
    columns = ("experiment", "fold", "map")
    for mean in held_out:
        some = [row for row in drives if all(row[one] == mean[one] for one in columns)]
        assert len({row["drive"] for row in some}) == len(some) == int(mean["sessions"])
        driven_m = np.array([float(row["driven_m"]) for row in some])
        assert driven_m.sum() == pytest.approx(float(mean["driven_m"]), rel=1e-5)
        for column in ("share_not_localised", "p_gt_5m"):
            shares = np.array([float(row[column]) for row in some])
            expected = shares @ driven_m / driven_m.sum()
            assert expected == pytest.approx(float(mean[column]), rel=1e-4, abs=1e-6)


def test_folds_may_be_run_one_after_another(plan: FleetPlan) -> None:
    def names(only: tuple[int, ...]) -> list[str]:
        options = replace(OPTIONS, only_folds=only)
        return [task.name for task in fleet_tasks(replace(plan, options=options))]

    assert all(name.startswith("A1 ") for name in names((1,)))
    assert names((0,)) + names((1,)) == names(())
    with pytest.raises(ConfigError, match="numbered from 0 to 1"):
        replace(OPTIONS, only_folds=(2,))


@pytest.mark.parametrize("kept", ["single.json", "runs-single*"])
def test_a_report_can_be_had_of_what_is_there_so_far(plan, tmp_path: Path, kept: str) -> None:
    """What a run leaves that was stopped early: files of one kind in one fold."""
    work = tmp_path / plan.work.name
    for path in plan.work.rglob(f"fold0/{kept}"):
        copy = work / path.relative_to(plan.work)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, copy)
    shutil.copy(plan.work / "configuration.json", tmp_path)
    assert write_fleet_report(tmp_path / "out", [replace(plan, work=work)])


def test_figures_and_comparisons_are_written(report: Path) -> None:
    names = {path.name for path in report.iterdir()}
    assert {f"fig{one}.png" for one in ("07_nodes", "07_failure", "08_failure", "09_nodes")} < names
    assert {"fig09_time.png", "fig09_failure.png", "fig10_orders.png", "orders.csv"} < names
    page = (report / "report.md").read_text()
    for words in ("29.36 %", "67.57 %", "22.44 %", "shared map against r1's own", "`tod`"):
        assert words in page


def test_the_merged_map_holds_the_training_drives_and_no_others(plan: FleetPlan) -> None:
    for fold in plan.folds:
        wanted = {one.session.id for one in plan.training(fold)}
        for name in ("single", "merged2-1"):
            with open_map(plan.folder(plan.arms[0], fold) / f"{name}.engram") as opened:
                assert set(opened.sessions) == wanted


def test_merging_omits_what_the_other_group_saw_alike(plan: FleetPlan) -> None:
    arm = ArmResult(plan, plan.arms[0])
    for fold in arm.folds:
        built = fold.parallel(2)
        assert built is not None
        assert built.nodes < sum(group[-1].nodes for group in built.groups)


def test_the_lost_are_timed_by_what_they_attempt_in_vain(plan: FleetPlan, monkeypatch) -> None:
    """Where every drive is found at once, too."""
    (fold, *_), options = plan.folds, RobotOptions("distance", 1, 8, relocaliser="exhaustive")
    drives = [one.path for one in plan.held_out(fold)]
    about = drives, steps.map_path(plan, plan.arms[0], fold, "single"), plan.settings, options
    assert steps.medians(*about)["proposed_ms"] > 0
    without = replace(options, relocaliser=None)
    assert steps.medians(*about[:-1], without)["proposed_ms"] == 0
    monkeypatch.setattr(steps, "accept_lost", lambda *_: True)
    assert steps.medians(*about)["proposed_ms"] == 0


def test_times_are_counts_times_medians(plan: FleetPlan) -> None:
    arm = ArmResult(plan, plan.arms[0])
    assert arm.stages is not None
    (fold, _) = arm.folds
    single = fold.single()
    assert single is not None
    frames, attempts = sum(x.frames for x in single), sum(x.attempts for x in single)
    proposed, lookups = sum(x.proposed for x in single), sum(x.lookups for x in single)
    expected_ms = (
        frames * arm.stages.frame_ms
        + (attempts - proposed) * arm.stages.attempt_ms
        + proposed * arm.stages.proposed_ms
        + lookups * arm.stages.lookup_ms
    )
    assert fold.time_of(single).counted_s == pytest.approx(expected_ms / 1e3)
    assert frames == sum(len(drive.frames()) for drive in plan.training(fold.fold))


@pytest.mark.parametrize(
    ("experiments", "maps"),
    [
        ((7, 8, 9, 10), ["single"]),
        ((10, 7), ["single"]),
        ((8, 9), ["r1-first"]),
        ((9, 10), ["r1-first"]),
        ((8, 10), ["orders-0"]),
        ((8,), []),
    ],
)
def test_medians_are_measured_in_the_first_map_of_what_is_timed(plan, experiments, maps) -> None:
    asked = replace(plan, options=replace(OPTIONS, experiments=experiments, only_folds=(0,)))
    needs = [task.needs for task in fleet_tasks(asked) if task.name == "A0 stages"]
    assert needs == [(f"A0 {name}",) for name in maps]


def without(plan: FleetPlan, work: Path, *patterns: str, **options) -> FleetPlan:
    """A copy of the study that lacks some files, and is asked for something else."""
    shutil.copytree(plan.work, work)
    for path in [path for pattern in patterns for path in work.rglob(pattern)]:
        path.unlink()
    return replace(plan, work=work, options=replace(OPTIONS, **options))


def test_orders_alone_are_timed(plan: FleetPlan, tmp_path: Path) -> None:
    other = without(plan, tmp_path / "work", "medians.json", experiments=(10,))
    run(other)
    medians = ArmResult(other, other.arms[0]).stages
    assert medians is not None
    assert medians.frame_ms > 0
    write_fleet_report(tmp_path / "out", [other])
    (built,) = [row for row in rows(tmp_path / "out") if row["counted_s"]]
    assert built["map"] == "one order built sequentially"
    assert float(built["counted_s"]) > 0
    (eq_8,) = compared(tmp_path / "out", ": by (8)")
    assert float(eq_8["ratio"]) > 0


def compared(report: Path, words: str) -> list[dict[str, str]]:
    return [row for row in rows(report, "comparisons.csv") if words in row["what"]]


def test_what_is_not_timed_is_left_empty(plan: FleetPlan, tmp_path: Path) -> None:
    """As in the studies of earlier versions, which had no medians without Fig. 7."""
    write_fleet_report(tmp_path / "out", [without(plan, tmp_path / "work", "medians.json")])
    table = rows(tmp_path / "out")
    for column in ("counted_s", "merges_counted_s", "counted_ms_per_frame"):
        assert {row[column] for row in table} == {""}
    assert any(float(row["wall_s"]) > 0 for row in table if row["wall_s"])
    out = tmp_path / "out"
    for words in ("time by counts", ": by (8)", "sequential prefix tree", "one that was built"):
        assert {row["ratio"] for row in compared(out, words)} == {""}
    assert all(float(row["ratio"]) > 0 for row in compared(out, "time by the clock"))
    (chosen,) = compared(out, "chosen order against")
    assert chosen["share_a"]
    assert chosen["share_b"]
    assert not (tmp_path / "out" / "fig07_nodes.png").exists()
    assert (tmp_path / "out" / "fig10_orders.png").exists()


@pytest.mark.parametrize("experiment", [7, 8, 9, 10])
def test_only_what_is_asked_for_is_reported(plan: FleetPlan, tmp_path: Path, experiment) -> None:
    asked = replace(plan, options=replace(OPTIONS, experiments=(experiment,)))
    written = write_fleet_report(tmp_path, [asked])
    assert {row["experiment"] for row in rows(tmp_path)} == {str(experiment)}
    pictures = {path.name.split("_")[0] for path in written if path.suffix == ".png"}
    assert pictures == {f"fig{experiment:02d}"} | ({"downloads"} if experiment == 9 else set())
    assert ("chosen" in (tmp_path / "orders.csv").read_text()) == (experiment == 10)
    page = (tmp_path / "report.md").read_text()
    said = {7: "29.36 %", 8: "shared map against", 9: "`tod`", 10: "22.44 %"}
    assert [one for one, words in said.items() if words in page] == [experiment]
    assert [f"(Fig. {one})\n" in page for one in said] == [one == experiment for one in said]


def test_arms_that_were_not_run_are_left_out(plan: FleetPlan, tmp_path: Path) -> None:
    both = replace(plan, options=replace(OPTIONS, arms=("A", "B")))
    write_fleet_report(tmp_path, [both])
    (nodes,) = compared(tmp_path, "2 groups, merged one after another, ÷ one agent: nodes")
    assert nodes["arm"] == "A"
    assert 0 < float(nodes["ratio"]) < 2
    assert {row["arm"] for row in rows(tmp_path, "comparisons.csv")} == {"A"}


def test_forays_in_copies_alone_are_not_reported(plan: FleetPlan, tmp_path: Path) -> None:
    """All that Fig. 8 leaves of Fig. 9, and what a run of that leaves that was stopped."""
    other = without(plan, tmp_path / "work", "field-r2-tod+paths-*", "downloads-*.json")
    written = write_fleet_report(tmp_path / "out", [other])
    assert {row["experiment"] for row in rows(tmp_path / "out")} == {"7", "8", "10"}
    assert not [path for path in written if path.name.startswith(("fig09", "downloads"))]


def test_a_robot_that_sets_out_when_nobody_does_takes_more_along(
    plan: FleetPlan, tmp_path: Path, monkeypatch
) -> None:
    """All drives of the campaign were soon after midnight."""
    other = without(plan, tmp_path / "work", "r1-tod+paths-download.*", "r1-tod-download.*")
    monkeypatch.setattr(steps, "hour_of_day", lambda *_: 12.5)
    for fold in other.folds:
        own, mission = other.forays(fold)["r1"]
        for policy in ("tod+paths", "tod"):
            about = (other, other.arms[0], fold, f"r1-{policy}-download")
            steps.download_for_foray(*about, "docked", policy, own, mission)
            made = read_download(steps.map_path(*about).with_suffix(".download.json"))
            assert made is not None
            assert (made.policy, made.nodes) == ("copy", made.of_nodes)
    write_fleet_report(tmp_path / "out", [other])
    asked = [row["asked_for_more"] for row in compared(tmp_path / "out", "download against `copy`")]
    assert asked == ["2", "2"]


@pytest.mark.parametrize("name", ["r2", "shared"])
def test_a_comparison_of_maps_is_reported_once_it_is_whole(plan, tmp_path: Path, name) -> None:
    firsts = [plan.held_out(fold)[0].key for fold in plan.folds]
    other = without(plan, tmp_path / "work", *(f"runs-{name}-{key}.npz" for key in firsts))
    write_fleet_report(tmp_path / "out", [other])
    assert "8" not in {row["experiment"] for row in rows(tmp_path / "out")}
    assert not (tmp_path / "out" / "fig08_failure.png").exists()


def test_a_finished_study_does_nothing_again(plan: FleetPlan) -> None:
    before = {path: path.stat().st_mtime_ns for path in plan.work.rglob("*.engram")}
    run(plan)
    assert {path: path.stat().st_mtime_ns for path in plan.work.rglob("*.engram")} == before


def test_a_study_that_was_stopped_comes_to_the_same_maps(campaign, plan, tmp_path) -> None:
    class StoppedError(Exception):
        pass

    class StopAfter(Monitor):
        def __init__(self, steps: int) -> None:
            self.left = steps

        def advance(self, word: str = "") -> None:
            self.left -= 1
            if self.left == 0:
                raise StoppedError

    other = make_fleet_plan(campaign, Settings(), replace(OPTIONS, experiments=(7,)), tmp_path)
    tasks = fleet_tasks(other)
    for count in range(3, len(tasks), 7):
        with pytest.raises(StoppedError):
            run_tasks(tasks, 1, StopAfter(count))
    run_tasks(tasks, 1, QUIET)
    (arm,) = plan.arms
    for name in ("single", "merged2-1", "pairs2-0-0"):
        for fold in plan.folds:
            hashes = []
            for one in (plan, other):
                with Map.open(one.folder(arm, fold) / f"{name}.engram") as store:
                    hashes.append(store.content_hash())
            assert hashes[0] == hashes[1]


def test_downloads_are_tried_for_as_many_held_out_drives_as_asked_for(plan: FleetPlan) -> None:
    for fold in plan.folds:
        assert len(list(plan.folder(plan.arms[0], fold).glob("downloads-*.json"))) == 1
        for drive in plan.held_out(fold)[:1]:
            path = plan.folder(plan.arms[0], fold) / f"downloads-{drive.key}.json"
            kept = json.loads(path.read_text())
            names = [one["name"] for one in kept["tried"]]
            assert names[:3] == ["copy", "tod", "tod+paths"]
            assert {*names, *kept["refused"]} >= {"budget 1/4", "budget 1/10", "budget as tod"}
            for one in kept["tried"]:
                assert one["nodes"] <= one["united"] <= one["of_nodes"]


def test_where_one_download_finds_nothing_the_others_are_tried(
    plan: FleetPlan, tmp_path: Path, monkeypatch
) -> None:
    """As where nobody drove at the hour of a held-out drive."""
    other, (arm,), fold = replace(plan, work=tmp_path), plan.arms, plan.folds[0]
    shutil.copytree(plan.folder(arm, fold), other.folder(arm, fold))
    drive = plan.held_out(fold)[0]
    steps.trials_path(other, arm, fold, drive).unlink()
    tried = steps.try_downloads

    def none_by_hour(centre, wanted, **options):
        if "tod+paths" in wanted:
            raise InputError("no epoch has data")
        return tried(centre, wanted, **options)

    monkeypatch.setattr(steps, "try_downloads", none_by_hour)
    steps.try_downloads_for(other, arm, fold, "shared", drive)
    kept = json.loads(steps.trials_path(other, arm, fold, drive).read_text())
    assert kept["refused"]["tod+paths"] == "no epoch has data"
    names = [one["name"] for one in kept["tried"]]
    assert names[:2] == ["copy", "tod"]
    assert not {"tod+paths", "budget as tod+paths"} & set(names)


def test_all_downloads_that_are_compared_leave_thumbnails_behind(
    plan: FleetPlan, tmp_path: Path, monkeypatch
) -> None:
    """Else `budget`, which has none, would get more nodes of as many bytes."""
    other, (arm,), fold = without(plan, tmp_path / "work"), plan.arms, plan.folds[0]
    drive = plan.held_out(fold)[0]
    steps.trials_path(other, arm, fold, drive).unlink()
    tried, with_thumbnails = steps.try_downloads, {}

    def look(centre, wanted, **options):
        with_thumbnails.update({name: one.with_thumbnails for name, one in wanted.items()})
        return tried(centre, wanted, **options)

    monkeypatch.setattr(steps, "try_downloads", look)
    steps.try_downloads_for(other, arm, fold, "shared", drive)
    names = {"copy", "tod", "tod+paths", "budget 1/4", "budget 1/10"}
    names |= {"budget as tod", "budget as tod+paths"}
    assert with_thumbnails == dict.fromkeys(names, False)


def test_trials_of_downloads_with_thumbnails_are_made_anew(plan, tmp_path: Path) -> None:
    other, (arm,), fold = without(plan, tmp_path / "work"), plan.arms, plan.folds[0]
    drive = plan.held_out(fold)[0]
    path = steps.trials_path(other, arm, fold, drive)
    kept = json.loads(path.read_text())
    del kept["thumbnails"]  # as an earlier version wrote it
    path.write_text(json.dumps(kept))
    assert not steps.read_trials(other, arm, fold, drive)
    steps.try_downloads_for(other, arm, fold, "shared", drive)
    assert steps.read_trials(other, arm, fold, drive)


def test_held_out_validation_and_groups_of_the_orders_are_apart(plan: FleetPlan) -> None:
    for fold in plan.folds:
        grouped = [one.path for group in plan.order_groups(fold) for one in group]
        parts = [
            grouped,
            *([x.path for x in some] for some in (plan.validation(fold), plan.held_out(fold))),
        ]
        together = [path for part in parts for path in part]
        assert len(together) == len(set(together))


def test_robots_drive_different_logs_in_the_order_of_time(plan: FleetPlan) -> None:
    (fold, _) = plan.folds
    forays = plan.forays(fold)
    starts = {r: [d.session.start_ns for foray in two for d in foray] for r, two in forays.items()}
    assert all(one == sorted(one) for one in starts.values())
    assert not set(starts["r1"]) & set(starts["r2"])


@pytest.mark.parametrize(
    ("training", "expected"), [(64, (7, 9, 8)), (32, (7, 7, 4)), (19, (4, 4, 2)), (5, (1, 1, 1))]
)
def test_protocols_are_scaled_to_the_drives_there_are(training: int, expected) -> None:
    found = Protocol.of(training)
    assert (found.foray, found.group, found.validation) == expected


def test_too_few_drives_are_refused() -> None:
    with pytest.raises(ConfigError, match="too few"):
        Protocol.of(4)


def test_unknown_arms_and_experiments_are_refused() -> None:
    with pytest.raises(ConfigError, match="arms"):
        FleetOptions(arms=("Z",))
    with pytest.raises(ConfigError, match="experiments"):
        FleetOptions(experiments=(6,))


def test_the_pairwise_tree_takes_one_merge_fewer_than_there_are_groups() -> None:
    for groups in range(2, 9):
        merges = pair_merges(groups)
        assert len(merges) == groups - 1
        used = [name for one in merges for name in (one.centre, one.robot)]
        assert len(used) == len(set(used))
        assert {f"group{groups}-{k}" for k in range(groups)} <= set(used)
