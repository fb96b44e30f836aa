"""Studies run by the settings that they are given, which is seen in what they really call."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lab.tests.evaluation.campaigns import LOOKS, few_options, write_campaign
from tests.cli.conftest import engram

from engram.cli.settings import AllSettings, every_setting, read_settings
from engram.config import config_hash, from_dict
from engram.errors import ConfigError
from engram.graph.paths import MATCHES_ONLY
from engram.localiser import localiser
from engram.localiser.attempts import Lanes, one_by_one
from engram.maps.map import open_map
from engram.monitor import QUIET
from engram.ranking.policies import POLICIES
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_on
from engram.sequences.framelog.reader import FrameLog
from engram_lab.studies import building, running
from engram_lab.studies.configurations import EVERYTHING, Configuration
from engram_lab.studies.drives import DriveSet, EvaluatedDrive, Fold
from engram_lab.studies.fleet import steps
from engram_lab.studies.fleet.experiments import fleet_tasks
from engram_lab.studies.fleet.plan import VERBS, FleetOptions, FleetPlan, arms_for, make_fleet_plan
from engram_lab.studies.fleet.report import ArmResult, write_fleet_report
from engram_lab.studies.in_force import OF_DRIVE, VARIED, by_key, differing, unused
from engram_lab.studies.lockstep import MatchMemo
from engram_lab.studies.plan import run_tasks
from engram_lab.studies.ranking_report import collect, write_report
from engram_lab.studies.running import Plan, localise_held_out, make_plan, run

__all__ = ["engram"]
PAPERS = ("linegar2015", "gadd2016")
PATH = Configuration("path", 2, 1)
OPTIONS = few_options(
    policies=("path", "distance"), lanes=(1, 2), rounds=(1,), only_folds=(0,), live_folds=1
)
FLEET = FleetOptions(
    arms=("S",), folds=2, groups=2, more_groups=(), order_groups=2, tried=1, only_folds=(0,),
)  # fmt: skip


def paper(name: str) -> AllSettings:
    return read_settings(Path(name))


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> DriveSet:
    return write_campaign(tmp_path_factory.mktemp("campaign"), LOOKS[:5])


@pytest.fixture(
    scope="module", params=[pytest.param(PAPERS[0], marks=pytest.mark.long), *PAPERS[1:]]
)
def plan(request, campaign, tmp_path_factory) -> Plan:
    plan = make_plan(campaign, paper(request.param), OPTIONS, tmp_path_factory.mktemp("work"))
    run(plan)
    return plan


@dataclass
class Seen:
    """What a frame's ranking saw, and how often `breadth_first` was called until then."""

    kinds: frozenset
    nodes: list[int]
    observed: list[int]
    calls: int


@pytest.fixture
def seen(monkeypatch) -> Iterator[list[Seen]]:
    """Notes every ranking by `path`."""
    calls, found = [0], list[Seen]()
    search, policy = localiser.breadth_first, POLICIES["path"]

    def counting(*arguments):
        calls[0] += 1
        return search(*arguments)

    class Spy:
        name = "path"

        def rank(self, context):
            near, observed = context.neighbourhood, context.observations.nodes
            kinds = frozenset(context.path_memory.kinds)
            found.append(Seen(kinds, near.nodes.tolist(), observed.tolist(), calls[0]))
            return policy().rank(context)

    monkeypatch.setattr(localiser, "breadth_first", counting)
    monkeypatch.setitem(POLICIES, "path", Spy)
    yield found
    found.clear()


def held_out(plan: Plan) -> tuple[Fold, EvaluatedDrive]:
    """A drive that the map of the first fold lacks, of a look that it knows."""
    fold = plan.folds[0]
    known = {LOOKS[number] for number in fold.training}
    number = next(one for one in fold.held_out if LOOKS[one] in known)
    return fold, plan.drives.drives[number]


def in_the_study(plan: Plan, configurations, *, memo: bool = True):
    """Runs configurations on a held-out drive."""
    fold, drive = held_out(plan)
    with open_map(plan.map_path(fold)) as opened:
        matcher = MatchMemo.of(opened, drive, plan.settings, plan.work) if memo else None
        return localise_held_out(
            opened, drive, drive.frames(), plan.training(fold), configurations, plan.settings,
            matcher, None,
        )  # fmt: skip


def on_a_robot(plan: Plan) -> list[bool]:
    """The product's own robot on the same drive, in the same map."""
    fold, drive = held_out(plan)
    log, tables = FrameLog(drive.path), plan.tables.drive
    asked = RobotOptions(tables.ranking, tables.lanes, tables.rounds, relocaliser=None)
    truth = drive.truth()
    with open_map(plan.map_path(fold)) as opened, robot_on(
        opened, log, plan.settings, asked
    ) as robot:  # fmt: skip
        nodes = building.true_nodes(opened, plan.training(fold))
        robot.place_at(nodes.start(truth.at(int(log.stamps_ns[0]))))
        return [one.localised for one in robot.drive(log)]


@pytest.mark.parametrize("memo", [True, False])
def test_a_held_out_drive_is_localised_as_by_the_products_robot(plan: Plan, seen, memo) -> None:
    matched = on_a_robot(plan)
    robot, calls = list(seen), seen[-1].calls
    seen.clear()
    runs = in_the_study(plan, [PATH], memo=memo)
    assert len(seen) == len(robot) == len(matched) > 10
    assert runs.matched[0].tolist() == matched
    for ours, its in zip(seen, robot, strict=True):
        assert ours.calls - calls == its.calls > 0
        assert (ours.kinds, ours.nodes, ours.observed) == (its.kinds, its.nodes, its.observed)
    assert seen[-1].kinds == MATCHES_ONLY


def test_each_configuration_searches_for_itself(plan: Plan, seen) -> None:
    one = in_the_study(plan, [PATH])
    once = seen[-1].calls
    both = in_the_study(plan, [PATH, PATH])
    assert seen[-1].calls == 3 * once
    assert both.matched.tolist() == [*one.matched.tolist()] * 2


def test_no_setting_in_force_differs_from_the_file(plan: Plan) -> None:
    found = collect(plan)
    for mode in ("memo", "live"):
        known = found.in_force(mode)
        assert known["localiser.neighbourhood"] == "breadth-first"
        assert len(known) > 60
        assert not differing(known, plan.tables)
    # Its maps have a policy and a budget of their own, which the page tells.
    assert set(differing(found.maps_in_force, plan.tables)) <= set(VARIED)
    drive = plan.tables.drive
    assert found.memo[Configuration(drive.ranking, drive.lanes, drive.rounds)].in_force


def test_what_is_in_force_stands_beside_every_table(plan: Plan, tmp_path: Path) -> None:
    write_report(tmp_path, [plan])
    lines = (tmp_path / "report.md").read_text().splitlines()
    tables = [at for at, line in enumerate(lines) if line.startswith("| ---")]
    assert len(tables) >= 3
    for at in tables:
        end = lines.index("", at)
        assert lines[end + 1].startswith(
            "In force: neighbourhood breadth-first, path entries match"
        )
        for words in ("T 10", "success first", "rule inliers", "features brief", "method "):
            assert words in lines[end + 1]
    page = "\n".join(lines)
    assert "Maps were made with `path-near`, Np = 2, Nr = 4" in page
    assert ("Not used by this study: `[merge]`, `[build]`" in page) is (
        plan.tables.build != AllSettings().build
    )
    with (tmp_path / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["neighbourhood"] for row in rows} == {"breadth-first"}
    assert {row["path_entries"] for row in rows if row["radius"] == "search"} >= {"matches"}
    with (tmp_path / "in_force.csv").open() as file:
        kept = list(csv.DictReader(file))
    assert {row["of"] for row in kept} == {"maps", "held out", "held out, as on a robot"}
    assert {row["setting"] for row in kept if row["differs"]} <= set(VARIED)


@pytest.mark.long
def test_what_the_study_sets_itself_is_told(campaign, tmp_path: Path) -> None:
    plan = make_plan(campaign, Settings(), OPTIONS, tmp_path / "work")
    run(plan)
    assert set(differing(collect(plan).in_force(), plan.tables)) == {"localiser.guide_below_m"}
    assert not differing(collect(plan).in_force("live"), plan.tables)
    write_report(tmp_path / "out", [plan])
    told = "set by the study itself, the settings' value in brackets: "
    assert (
        f"{told}`localiser.guide_below_m = 0.0` (0.6)." in (tmp_path / "out/report.md").read_text()
    )


def test_where_the_first_success_counts_all_attempts_and_candidates_do(plan: Plan) -> None:
    runs = in_the_study(plan, [EVERYTHING, Configuration("distance", 1)])
    everything, one = runs.attempts
    assert (everything == runs.candidates[0]).all()
    assert runs.succeeded[0].max() > 1 == runs.succeeded[1].max()
    assert runs.matched[0].sum() > 10
    assert one.sum() < everything.sum()
    # Breadth first reaches what hangs together: the first success would be one node a frame.
    assert runs.near_seen[0].sum() > 0.7 * runs.near[0].sum() > 5 * runs.matched[0].sum()


def test_attempts_beside_the_first_success_were_made(plan: Plan) -> None:
    fold, drive = held_out(plan)

    class Counting(Lanes):
        calls = 0
        matches = one_by_one

        def match(self, *arguments):
            self.calls += 1
            return super().match(*arguments)

    with open_map(plan.map_path(fold)) as opened:
        counting = Counting(opened.frames, plan.settings.localiser.matcher)
        runs = localise_held_out(
            opened, drive, drive.frames(), plan.training(fold), [Configuration("distance", 4)],
            plan.settings, counting, None,
        )  # fmt: skip
    assert runs.attempts.sum() == counting.calls > len(runs.step_m)


# -- every setting of a file


def changed(value: Any, key: str) -> Iterator[Any]:
    """Other values for a setting, of which one is within its bounds."""
    words = {"ranking": ["distance"], "relocaliser": ["bag-of-words"], "estimator": ["gap"]}
    words |= {"unit": ["segment"], "seed": ["places"], "neighbourhood": ["breadth-first"]}
    words |= {"path_entries": ["matches"], "success": ["first"], "rule": ["inliers"]}
    words |= {"T_unit": ["frame"], "descriptor": ["net"], "memory": ["200MB"]}
    words |= {"format": ["kitti"], "rig": ["colour"], "channel": ["red"], "motion": [["/odom"]]}
    yield from words.get(key.rpartition(".")[2], ())
    if isinstance(value, bool):
        yield not value
    elif isinstance(value, int):
        yield from (value + 1, value - 1, value + 8)
    elif isinstance(value, float):
        yield from (0.9 * value, 1.1 * value, 0.5, 1.0)
    elif value is None:
        yield from (9, 9.5, True, "other")
    elif isinstance(value, list):
        yield from (value[:-1], [*value, *value[-1:]])


def nested(key: str, value: Any) -> dict[str, Any]:
    name, _, rest = key.partition(".")
    return {name: nested(rest, value) if rest else value}


def altered(key: str, value: Any) -> tuple[AllSettings, Any]:
    """Settings that differ in one."""
    for other in changed(value, key):
        try:
            found = from_dict(nested(key, other), AllSettings)
        except ConfigError:
            continue
        kept = by_key(found)[key]
        if kept != value:
            return found, kept
    raise AssertionError(f"{key}: no other value than {value!r} found")


EVERY = {one.key: one.value for one in every_setting(AllSettings())}
HELD_OUT = ("localiser", "gaps")
IN_LOGS = ("frontend", "odometry")
IN_MAPS = ("localiser", "mapper", "doctor", "outside", "gaps", "fixed", "frozen", "placing")
MADE_ONCE = ("localiser.lost_max_samples", "localiser.lost_max_hypotheses")
# Downloads are compared by their bytes: all that are tried out are sent without.
THUMBNAILS = "download.thumbnails"
# What a fleet study sets itself, by what runs so: one match serves the lost and others.
SET_BY_FLEET = {"held out": {*MADE_ONCE}, "downloads tried": {THUMBNAILS}}


def of(*tables: str) -> list[str]:
    """The settings of tables; of `drive` those that studies read."""
    some = [key for key in EVERY if key.partition(".")[0] in tables]
    return [key for key in some if key in OF_DRIVE or not key.startswith("drive.")]


def test_every_table_is_held_to_something() -> None:
    known = {*HELD_OUT, *IN_LOGS, *IN_MAPS, *VERBS, "repair", "islands", "weak_spots"}
    assert {key.partition(".")[0] for key in EVERY} == known
    assert len(EVERY) > 150


@pytest.fixture(scope="module")
def usual(campaign, tmp_path_factory) -> Plan:
    """A study of default settings, whose first map is built."""
    plan = make_plan(campaign, Settings(), OPTIONS, tmp_path_factory.mktemp("usual"))
    running._build(plan, plan.folds[0])
    return plan


@pytest.mark.parametrize("table", [pytest.param("localiser", marks=pytest.mark.long), "gaps"])
def test_a_held_out_drive_has_every_setting(usual: Plan, table: str) -> None:
    fold = usual.folds[0]
    drive = usual.drives.drives[fold.held_out[0]]
    frames = drive.frames()[:1]
    with open_map(usual.map_path(fold)) as opened:
        memo = Lanes(opened.frames, usual.settings.localiser.matcher)
        for key in of(table):
            settings, value = altered(key, EVERY[key])
            for matcher in (None, memo):
                if matcher is not None and key in (*MADE_ONCE, "localiser.guide_below_m"):
                    continue  # refused where it is asked for, and told
                runs = localise_held_out(
                    opened, drive, frames, usual.training(fold), [PATH], settings.of_robot(),
                    matcher, None,
                )  # fmt: skip
                assert runs.in_force[0][key] == value, key


@pytest.mark.parametrize("key", [*of(*IN_LOGS), *MADE_ONCE])
def test_a_setting_that_the_drives_were_not_made_by_is_refused(campaign, tmp_path, key) -> None:
    settings, _ = altered(key, EVERY[key])
    for make, options in (
        (make_plan, replace(OPTIONS, relocaliser="fabmap")),
        (make_fleet_plan, FLEET),
    ):
        with pytest.raises(ConfigError, match=key):
            make(campaign, settings, options, tmp_path / "work")
    assert not (tmp_path / "work").exists()


def test_drives_that_were_made_by_a_setting_are_evaluated(campaign, tmp_path: Path) -> None:
    settings, _ = altered("odometry.min_inliers", EVERY["odometry.min_inliers"])
    made = config_hash(settings.for_descriptor(None).odometry)
    drives = tuple(replace(one, odometry=made) for one in campaign.drives)
    make_plan(replace(campaign, drives=drives), settings, OPTIONS, tmp_path)
    with pytest.raises(ConfigError, match=r"odometry\.min_inliers"):
        make_plan(campaign, settings, OPTIONS, tmp_path)


class _SeenError(Exception):
    """Ends a step once it has called what is looked at."""


def given_to(monkeypatch, module, name: str) -> list[tuple[tuple, dict]]:
    """Notes what a step gives to a function, and ends it there."""
    calls: list[tuple[tuple, dict]] = []

    def look(*arguments, **options):
        calls.append((arguments, options))
        raise _SeenError

    monkeypatch.setattr(module, name, look)
    return calls


@pytest.mark.long
def test_maps_have_every_setting(campaign, tmp_path: Path, monkeypatch) -> None:
    calls = given_to(monkeypatch, building, "map_drive")
    for key in of(*IN_MAPS):
        settings, value = altered(key, EVERY[key])
        plan = make_plan(campaign, settings, OPTIONS, tmp_path)
        with pytest.raises(_SeenError):
            running._build(plan, plan.folds[0])
        assert by_key(calls[-1][0][2])[key] == value, key


@pytest.mark.parametrize("key", of("merge", "build", "download", "repair", "islands"))
def test_a_table_that_a_study_does_not_read_is_told(key: str) -> None:
    settings, _ = altered(key, EVERY[key])
    table = key.partition(".")[0]
    (told,) = unused(settings, set(OF_DRIVE))
    assert told == f"- Not used by this study: `[{table}]`."


@pytest.mark.parametrize("key", [one for one in EVERY if one.startswith("drive.")])
def test_a_setting_of_drives_is_read_or_told(key: str) -> None:
    settings, _ = altered(key, EVERY[key])
    told = list(unused(settings, set(OF_DRIVE)))
    assert told == ([] if key in OF_DRIVE else [f"- Not used by this study: `{key}`."])


def test_threads_are_those_of_the_settings(usual: Plan, campaign, tmp_path, monkeypatch) -> None:
    settings = from_dict({"drive": {"threads": 3}}, AllSettings)
    plan = replace(usual, tables=settings, options=replace(OPTIONS, lanes=(2,)))
    calls = given_to(monkeypatch, running, "localise_held_out")
    with pytest.raises(_SeenError):
        running._run_live(plan, plan.folds[0], plan.folds[0].held_out[0])
    assert calls[0][0][-1] == 1
    few = from_dict({"drive": {"threads": 1}}, AllSettings)
    for make, options in ((make_plan, OPTIONS), (make_fleet_plan, FLEET)):
        with pytest.raises(ConfigError, match="threads is 1, must be at least"):
            make(campaign, few, options, tmp_path)


# -- the fleet study


@pytest.fixture(scope="module")
def drives(tmp_path_factory) -> DriveSet:
    folder = tmp_path_factory.mktemp("fleet")
    return write_campaign(folder, (0, 1) * 4, road=np.arange(0.0, 9.0, 0.9))


def test_arms_are_those_of_the_settings_where_these_set_what_arms_do() -> None:
    assert arms_for(AllSettings()) == ("A", "B", "C")
    assert [arms_for(paper(name)) for name in PAPERS] == [("S",)] * 2
    assert arms_for(from_dict({"merge": {"unit": "segment"}}, AllSettings)) == ("A", "B", "C")
    assert arms_for(from_dict({"merge": {"sure_inliers": 50}}, AllSettings)) == ("S",)


def test_an_arm_leaves_to_the_settings_what_it_does_not_set(drives, tmp_path: Path) -> None:
    plan = make_fleet_plan(drives, paper("gadd2016"), replace(FLEET, arms=("A", "P")), tmp_path)
    for arm, sure_inliers in zip(plan.arms, (0, 0), strict=True):
        assert (arm.driving.ranking, arm.merging.ranking) == ("distance", "distance")
        assert (arm.merging.lanes, arm.merging.rounds) == (2, 4)
        assert (arm.merging.unit, arm.merging.seed) == ("segment", "places")
        assert arm.merging.sure_inliers == sure_inliers
    (usual, as_published) = make_fleet_plan(
        drives, AllSettings(), replace(FLEET, arms=("A", "P")), tmp_path
    ).arms
    assert (usual.merging.sure_inliers, as_published.merging.sure_inliers) == (45, 0)


@pytest.fixture(scope="module")
def fleet(drives, tmp_path_factory) -> FleetPlan:
    """A study of [G16]'s settings that is run."""
    folder = tmp_path_factory.mktemp("work")
    plan = make_fleet_plan(drives, paper("gadd2016"), FLEET, folder)
    run_tasks(fleet_tasks(plan), 1, QUIET)
    return plan


@pytest.mark.long
def test_no_setting_in_force_in_a_fleet_differs_from_the_file(fleet, tmp_path: Path) -> None:
    (arm,) = [ArmResult(fleet, one) for one in fleet.arms]
    known = arm.in_force()
    kinds = {"maps", "merges", "downloads", "downloads tried", "held out", "orders"}
    assert set(known) == kinds
    in_file = {key for key, value in by_key(fleet.tables).items() if value != EVERY[key]}
    assert len(in_file) > 10
    for name, values in known.items():
        assert values, name
        assert set(differing(values, fleet.tables)) == SET_BY_FLEET.get(name, set()) - in_file, name
    assert known["maps"]["drive.ranking"] == "path"
    assert known["merges"]["merge.unit"] == "segment"
    assert known["downloads"]["download.window_min"] == 180.0
    assert known["orders"] == {"build.max_gap_m": 10.0, "build.estimator": "reacquired"}
    write_fleet_report(tmp_path, [fleet])
    page = (tmp_path / "report.md").read_text()
    tables = page.count("\n| --- ")
    assert page.count("- Arm S. In force: neighbourhood breadth-first") == tables > 3
    tried, lost = [line for line in page.splitlines() if " by the study itself" in line]
    assert tried.startswith("- Arm S, downloads tried, set by the study itself, ")
    assert tried.endswith(": `download.thumbnails = False` (None).")
    assert lost.startswith("- Arm S, held out, set by the study itself, ")
    assert "`localiser.lost_max_samples = 512` (256), `localiser.lost_max_hyp" in lost
    with (tmp_path / "in_force.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["of"] for row in rows} == set(known)
    assert {row["setting"] for row in rows if row["differs"]} == {*MADE_ONCE, THUMBNAILS}


@pytest.mark.long
def test_robots_merges_and_held_out_drives_of_a_fleet_have_every_setting(
    fleet, drives, tmp_path: Path, monkeypatch
) -> None:
    mapped = given_to(monkeypatch, building, "map_drive")
    merged = given_to(monkeypatch, steps, "merge_maps")
    held_out = given_to(monkeypatch, steps, "localise_held_out")
    for key in of(*IN_MAPS, "drive", "merge"):
        if key in MADE_ONCE:
            continue
        settings, value = altered(key, EVERY[key])
        plan = replace(make_fleet_plan(drives, settings, FLEET, tmp_path), work=fleet.work)
        (arm,), fold = plan.arms, plan.folds[0]
        drive = plan.held_out(fold)[0]
        steps.runs_path(plan, arm, fold, "single", drive).unlink(missing_ok=True)
        about = plan, arm, fold
        for step in (
            partial(steps.map_drives, *about, "new", plan.training(fold)),
            partial(steps.merge, *about, "new", "group2-0", "group2-1"),
            partial(steps.localise_in, *about, drive, ["single"]),
        ):
            with pytest.raises(_SeenError):
                step()
        name = key.partition(".")[2]
        options = mapped[-1][0][3]
        table = key.partition(".")[0]
        if table == "drive":
            asked = {"ranking": options.ranking, "lanes": options.lanes, "rounds": options.rounds}
            assert {**asked, "threads": options.threads}[name] == value
            configuration = held_out[-1][0][4][0]
            if name in asked:
                assert getattr(configuration, {"ranking": "policy"}.get(name, name)) == value
        elif table == "merge":
            assert by_key(merged[-1][0][2])[name] == value
        else:
            for settings in (mapped[-1][0][2], merged[-1][1]["settings"], held_out[-1][0][5]):
                assert by_key(settings)[key] == value, key


@pytest.mark.long
def test_downloads_and_orders_of_a_fleet_have_every_setting(
    fleet, drives, tmp_path: Path, monkeypatch
) -> None:
    sent = given_to(monkeypatch, steps, "download")
    tried = given_to(monkeypatch, steps, "try_downloads")
    ordered = given_to(monkeypatch, steps, "find_best_order")
    for key in of("download", "build", "drive"):
        settings, value = altered(key, EVERY[key])
        plan = replace(make_fleet_plan(drives, settings, FLEET, tmp_path), work=fleet.work)
        (arm,), fold = plan.arms, plan.folds[0]
        drive = plan.held_out(fold)[0]
        own, mission = plan.forays(fold)["r1"]
        steps.trials_path(plan, arm, fold, drive).unlink(missing_ok=True)
        (plan.folder(arm, fold) / "orders.json").unlink(missing_ok=True)
        about = plan, arm, fold
        for step in (
            partial(steps.download_for_foray, *about, "new", "docked", "tod", own, mission),
            partial(steps.try_downloads_for, *about, "shared", drive),
            partial(steps.try_orders, *about, ["orders-0", "orders-1"]),
        ):
            with pytest.raises(_SeenError):
                step()
        table, _, name = key.partition(".")
        judge, driving = ordered[-1][0][4], tried[-1][1]["localise"]
        if table == "download":
            (asked,) = tried[-1][0][1].values()
            assert by_key(sent[-1][0][2])[name] == value
            assert by_key(asked)[name] == (False if key == THUMBNAILS else value)
        elif table == "build":
            assert {"max_gap_m": judge.judge_at_m, "estimator": judge.estimator}[name] == value
        else:
            assert getattr(driving, name) == getattr(judge.localising, name) == value


@pytest.mark.long
def test_a_study_by_the_command_line_says_what_it_ran_by(engram, campaign, tmp_path: Path) -> None:
    logs = [one.path for one in campaign.drives]
    ran = engram(
        "lab", "evaluate", "ranking", *logs, "--config", "linegar2015", "--policies", "path",
        "--lanes", "2", "--rounds", "1", "--folds", "2", "--only-folds", "0", "--no-map-sizes",
        "--live-folds", "0", "--workers", "1", "--work", tmp_path / "work", "--out", tmp_path,
    )  # fmt: skip
    assert ran.status == 0, ran.err
    with (tmp_path / "in_force.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["setting"] for row in rows if row["differs"]} <= set(VARIED)
