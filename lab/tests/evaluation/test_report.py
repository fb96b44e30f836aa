"""Tables, figures and claims from results that are made up, so that what they say is known."""

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
from tests.builders import CAMERA

from engram.errors import InputError
from engram.frontend.frame import BRIEF
from engram.graph.model import Clock, Session, SessionId
from engram.robot.settings import Settings
from engram_lab.policies import STUDIED
from engram_lab.studies.configurations import UNLIMITED, Configuration, map_sizes, sweep
from engram_lab.studies.drives import DriveSet, EvaluatedDrive
from engram_lab.studies.lockstep import Runs, only, read_runs, write_runs
from engram_lab.studies.ranking_report import (
    POLICY_COLOURS,
    ConfigurationResult,
    collect,
    draw_figures,
    labelled,
    measure_rows,
    policy_rows,
    summary_rows,
    write_report,
)
from engram_lab.studies.running import Plan, RankingOptions, make_plan

FRAMES = 400
SESSIONS = 10
# Share of steps that end without a match, at Np = 2 in the whole map.
MISSES = {"oracle": 0.02, "recall": 0.03, "bandit": 0.06, "path-near": 0.05, "distance": 0.17}


def made_up_drive(number: int) -> EvaluatedDrive:
    session = Session(SessionId(UUID(int=number)), "robot", CAMERA.id, number, Clock.UTC)
    path = Path(f"{number:03d}.framelog")
    return EvaluatedDrive(path, session, CAMERA, BRIEF, "made up", "", "known")


def miss_share(one: Configuration) -> float:
    share = MISSES[one.policy] * (2.0 / min(one.lanes, 8)) ** 0.5
    share *= 1.0 if one.T is None or one.T >= 5 else 1.5
    return share * (1.0 if one.sessions is None else 1.0 + 2.0 / one.sessions)


def made_up_runs(session: int, configurations) -> Runs:
    """Every k-th frame missed in runs of 20, the same frames for all, the more the worse."""
    runs = Runs.empty(configurations, np.full(FRAMES, 0.7))
    order = np.random.default_rng(session).permutation(FRAMES // 20)
    block_rank = np.argsort(order)
    for row, one in enumerate(configurations):
        missed_blocks = round(miss_share(one) * FRAMES / 20)
        runs.matched[row] = np.repeat(block_rank >= missed_blocks, 20)
        runs.attempts[row] = min(one.lanes * one.rounds, 12)
        runs.candidates[row], runs.succeeded[row] = 12, 3
        runs.near[row], runs.near_seen[row] = 10, 9
        runs.offset_m[row, runs.matched[row]] = 0.02
        runs.turn_rad[row, runs.matched[row]] = 0.001
        runs.step_ms[row] = 0.3
    runs.offset_m[0, np.flatnonzero(runs.matched[0])[0]] = 1.5  # one false success, of the oracle
    return runs


@pytest.fixture(scope="module")
def plan(tmp_path_factory, monkeypatch_module=None) -> Plan:
    work = tmp_path_factory.mktemp("work")
    drives = DriveSet("made-up", tuple(made_up_drive(k) for k in range(SESSIONS)))
    options = RankingOptions(
        policies=tuple(MISSES), lanes=(1, 2, 8, UNLIMITED), folds=5, live_folds=1
    )
    plan = Plan(drives, Settings(), options, work)
    for fold in plan.folds:
        sessions = [
            {"name": str(k), "revision": k, "nodes": 100 * k, "share_localised": 0.5, "seconds": 1}
            for k in range(1, len(fold.training) + 1)
        ]
        plan.map_path(fold).with_suffix(".json").write_text(json.dumps({"sessions": sessions}))
        for session in fold.held_out:
            configurations = (
                *sweep(options.policies, options.lanes, options.rounds),
                *map_sizes(options.policies, 2, len(fold.training)),
            )
            write_runs(plan.runs_path(session, "memo"), made_up_runs(session, configurations))
            if fold.number == 0:
                live = [Configuration(one, 2) for one in MISSES if one != "oracle"]
                guided = made_up_runs(session, live)
                guided.matched[live.index(Configuration("path-near", 2))] = True
                write_runs(plan.runs_path(session, "live"), guided)
    return plan


@pytest.fixture(scope="module")
def out(plan: Plan, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("out")
    report = write_report(out, [plan])
    assert sorted(report.files) == sorted(out.iterdir())
    shown = [line.split() for line in report.text.splitlines()]
    assert ["policy", "route", "not", "localised", "P(>", "10", "m)", "beats", "distance"] in shown
    assert {*MISSES} <= {words[0] for words in shown if words[-1:] in (["yes"], ["–"])}
    return out


@pytest.fixture(scope="module")
def rows(out: Path) -> list[dict[str, str]]:
    with (out / "summary.csv").open() as file:
        return list(csv.DictReader(file))


def one_row(rows, **wanted: str) -> dict[str, str]:
    usual = {"lanes": "2", "rounds": "1", "T": "10", "radius": "search", "paths": "matched+saved"}
    usual |= {"mode": "memo", "fold": "all", "map_sessions": ""}
    [row] = [r for r in rows if all(r[key] == value for key, value in (usual | wanted).items())]
    return row


def test_the_columns_that_the_study_needs_are_there(rows) -> None:
    wanted = "campaign policy lanes rounds T fold sessions frames p_gt_10m share_not_localised"
    wanted += " attempts_per_frame ms_per_frame false_successes median_error_m"
    assert set(wanted.split()) <= set(rows[0])


def test_shares_are_those_that_were_made_up(rows) -> None:
    # 17 % of 20 blocks are 3 blocks: 15 % of every session.
    row = one_row(rows, policy="distance")
    assert float(row["share_not_localised"]) == pytest.approx(0.15)
    assert (row["sessions"], row["frames"]) == (str(SESSIONS), str(SESSIONS * FRAMES))
    assert float(row["share_not_localised_low"]) == pytest.approx(0.15)
    # A missed block is a gap of 21 steps, 14.7 m; side by side they make longer ones.
    assert float(row["longest_gap_m"]) >= 14.7 - 1e-6
    assert float(row["p_gt_10m"]) > 0
    assert float(one_row(rows, policy="oracle")["share_not_localised"]) == 0
    assert float(row["excess_not_localised"]) == pytest.approx(0.15)
    assert float(row["median_error_m"]) == pytest.approx(0.02, abs=1e-6)


def test_dry_and_wet_drives_stand_apart_by_every_estimator(plan: Plan, out: Path) -> None:
    page = (out / "report.md").read_text()
    head = "| policy | drives | P(> 10 m), route | P(> 10 m), gap | P(> 10 m), lost |"
    assert head in page
    assert f"| distance | {SESSIONS} dry |" in page  # names that say no weather
    names = ["a-rain-b", *["a-clear-b"] * (SESSIONS - 1)]
    drives = tuple(
        replace(one, path=one.path.with_name(f"{name}-{k}.framelog"))
        for k, (name, one) in enumerate(zip(names, plan.drives.drives, strict=True))
    )
    campaign = collect(plan)
    named = {
        one: ConfigurationResult(
            one, [replace(each, name=drives[each.session].name) for each in result.sessions]
        )
        for one, result in campaign.memo.items()
    }
    found = measure_rows(replace(campaign, memo=named))
    ours = {one["drives"]: one for one in found if one["policy"] == "distance"}
    assert set(ours) == {"1 wet", f"{SESSIONS - 1} dry"}
    assert ours["1 wet"]["share_not_localised"] == pytest.approx(0.15)
    assert 0 < ours["1 wet"]["p_gt_10m_gap"] < ours["1 wet"]["p_gt_10m_lost"] <= 1


def test_folds_have_rows_of_their_own(rows) -> None:
    folds = [one_row(rows, policy="path-near", fold=str(k)) for k in range(5)]
    assert sum(int(row["sessions"]) for row in folds) == SESSIONS
    assert {row["share_not_localised_low"] for row in folds} == {""}


def test_only_unmemoised_runs_tell_milliseconds(rows) -> None:
    assert one_row(rows, policy="path-near")["ms_per_frame"] == ""
    live = one_row(rows, policy="path-near", mode="live")
    assert float(live["ms_per_frame"]) == pytest.approx(0.3)
    assert live["sessions"] == "2"


def test_false_successes_are_counted(rows) -> None:
    found = {
        row["policy"]: int(row["false_successes"])
        for row in rows
        if row["mode"] == "memo" and row["fold"] == "all" and row["lanes"] == "1"
        and row["rounds"] == "1" and row["paths"] == "matched+saved"
    }  # fmt: skip
    assert found["oracle"] == SESSIONS
    assert found["path-near"] == 0


def test_every_figure_is_drawn(out: Path) -> None:
    pictures = {path.name for path in out.glob("*.png")}
    assert pictures == {
        "fig09_map_size.png",
        "fig10_candidates.png",
        "fig11_lanes.png",
        "fig11_lanes_not_localised.png",
        "fig11_lanes_against_distance.png",
        "fig12_curves_route.png",
        "fig12_curves_gap.png",
        "fig12_curves_lost.png",
        "fig12_curves_lost_scaled.png",
        "fig12_curves_reacquired.png",
        "fig13_T.png",
        "costs_made-up.png",
    }


@pytest.mark.long
def test_a_policy_has_one_colour_in_all_figures(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from matplotlib import pyplot

    looks: dict[str, set[tuple[str, str]]] = {}

    def keep(figure, path: Path) -> None:
        for legend in figure.legends:
            for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=True):
                look = (handle.get_color(), handle.get_linestyle())
                looks.setdefault(text.get_text(), set()).add(look)
        pyplot.close(figure)

    monkeypatch.setattr("engram_lab.charts.save", keep)
    found = collect(plan)
    draw_figures(tmp_path, [found], summary_rows(found))
    assert looks["recall"] == {("black", "-")}
    assert looks["path-near, matched only"] == {(POLICY_COLOURS["path-near"], "--")}
    for policy in MISSES:
        assert looks[policy] == {(POLICY_COLOURS[policy], "-")}


def test_every_policy_has_a_colour_of_its_own() -> None:
    assert POLICY_COLOURS.keys() == set(STUDIED)
    assert len(set(POLICY_COLOURS.values())) == len(STUDIED)


@pytest.fixture(scope="module")
def comparisons(out: Path) -> dict[str, dict[str, str]]:
    with (out / "comparisons.csv").open() as file:
        return {row["what"]: row for row in csv.DictReader(file)}


def test_what_the_paper_claims_is_compared_on_the_same_sessions(comparisons) -> None:
    # distance misses 3 blocks of 20, path-near 1, the oracle none: 3 times the excess.
    excess = comparisons["`distance` ÷ `path-near`, Np = 2: excess over the oracle"]
    assert [float(excess[one]) for one in ("ratio", "ratio_low", "ratio_high")] == [3.0] * 3
    near = comparisons["nodes truly within 8 m and 60° of a localised robot that are candidates"]
    assert float(near["share_a"]) == pytest.approx(0.9)
    # One of 20 blocks against none: 5.5 ÷ 0.5.
    to_bound = comparisons["`recall` ÷ `oracle`: route not localised, 0.5 % added to both"]
    assert float(to_bound["ratio"]) == pytest.approx(11.0)
    beaten = comparisons["`recall` against `distance`"]
    assert float(beaten["share_a"]) == pytest.approx(0.05)
    assert float(beaten["share_b"]) == pytest.approx(0.15)
    for end in ("minus_b", "minus_b_low", "minus_b_high"):
        assert float(beaten[end]) == pytest.approx(-0.1)


def test_runs_as_on_a_robot_stand_beside_the_unguided_ones_of_the_same_sessions(
    comparisons,
) -> None:
    assert not [what for what in comparisons if what.startswith("`oracle` as on a robot")]
    for policy, live, memo in (("distance", 0.15, 0.15), ("path-near", 0.0, 0.05)):
        row = comparisons[f"`{policy}` as on a robot against unguided, 2 sessions"]
        assert float(row["share_a"]) == pytest.approx(live)
        assert float(row["share_b"]) == pytest.approx(memo)


@pytest.mark.long
def test_several_campaigns_are_pooled(plan: Plan, out: Path, tmp_path: Path) -> None:
    assert "pooled\n" not in (out / "report.md").read_text()
    other = replace(plan, drives=replace(plan.drives, name="made-up again"))
    write_report(tmp_path, [plan, other])
    with (tmp_path / "comparisons.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["campaign"] == "pooled"]
    # One block of 20 against 3, in every session of both.
    (row,) = [row for row in rows if row["what"] == "`recall` against `distance`"]
    assert float(row["minus_b"]) == pytest.approx(-0.1)
    assert "## All sessions pooled" in (tmp_path / "report.md").read_text()


def test_the_page_shows_every_policy_and_the_sweeps(out: Path) -> None:
    lines = (out / "report.md").read_text().splitlines()
    for policy in MISSES:
        assert any(line.startswith(f"| {policy} | ") for line in lines)
    at = lines.index("Route not localised by the number of lanes")
    (distance,) = [
        line
        for line in lines[:at]
        if line.startswith("| distance | ") and not re.search(r"\| \d+ (dry|wet) \|", line)
    ]
    assert " | 15.00 % (15.00 … 15.00) | " in distance
    assert lines[at + 2] == "| label | 1 | 2 | 8 | unlimited |"
    swept = lines[at : lines.index("", at + 2)]
    # 5, 3, 2 and 2 of 20 blocks.
    assert "| distance, Nr = 1 | 25.00 % | 15.00 % | 10.00 % | 10.00 % |" in swept
    assert any(line.startswith("| path-near, matched only, Nr = 1 |") for line in swept)
    at = lines.index("P(> 10 m) as the map grows: sessions in the map (nodes)")
    assert lines[at + 2].startswith("| policy | 1 (100) | 2 (200) | ")
    assert lines[at + 2].endswith(" | all (800) |")


@pytest.mark.parametrize("policy", ["path-near", "recall"])
def test_what_was_not_run_is_left_out(plan: Plan, tmp_path: Path, policy: str) -> None:
    work = tmp_path / "work"
    work.mkdir()
    bare = replace(plan, work=work, options=replace(plan.options, policies=(policy,)))
    for fold in plan.folds:
        source = plan.map_path(fold).with_suffix(".json")
        (work / source.name).write_bytes(source.read_bytes())
        for session in fold.held_out:
            only = [Configuration(policy, 2), Configuration(policy, UNLIMITED)]
            write_runs(bare.runs_path(session, "memo"), made_up_runs(session, only))
    files = {path.name for path in write_report(tmp_path / "out", [bare]).files}
    assert "fig11_lanes.png" in files
    assert not {"fig09_map_size.png", "fig10_candidates.png", "fig13_T.png"} & files


@pytest.mark.long
def test_what_was_not_run_in_every_session_is_left_out(plan: Plan, tmp_path: Path) -> None:
    work = tmp_path / "work"
    shutil.copytree(plan.work, work)
    begun = replace(plan, work=work)
    path = begun.runs_path(plan.folds[0].held_out[0], "memo")
    runs = read_runs(path)
    assert runs is not None
    unfinished = Configuration("distance", 8)
    write_runs(path, only(runs, set(runs.configurations) - {unfinished}))
    found = collect(begun)
    assert unfinished not in found.memo
    assert found.memo.keys() == collect(plan).memo.keys() - {unfinished}
    assert {len(one.sessions) for one in found.memo.values()} == {SESSIONS}
    assert found.left_out == {unfinished: SESSIONS - 1}
    write_report(tmp_path / "out", [begun])
    told = (tmp_path / "out" / "report.md").read_text()
    assert f"not run on the same {SESSIONS} sessions: distance (Np = 8) on {SESSIONS - 1}." in told
    # Only the folds that have it: there it is shown.
    other = replace(begun, options=replace(begun.options, only_folds=(1,)))
    assert unfinished in collect(other).memo
    assert not collect(other).left_out


def with_runs(plan: Plan, work: Path, mode: str, run: dict[int, tuple[str, ...]]) -> Plan:
    """A plan of which nothing was run but, in each session, some policies at Np = 2."""
    shutil.copytree(plan.work, work, ignore=shutil.ignore_patterns(f"{mode}-*"))
    other = replace(plan, work=work)
    for session, policies in run.items():
        configurations = [Configuration(one, 2) for one in policies]
        write_runs(other.runs_path(session, mode), made_up_runs(session, configurations))
    return other


def test_policies_beat_distance_only_where_the_interval_lies_below_0(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(MISSES, "path", MISSES["distance"])
    monkeypatch.setitem(MISSES, "random", 0.4)
    policies = ("distance", "recall", "path", "random")
    held_out = [session for fold in plan.folds for session in fold.held_out]
    made = with_runs(plan, tmp_path / "work", "memo", dict.fromkeys(held_out, policies))
    made = replace(made, options=replace(made.options, policies=policies))
    found = collect(made)
    rows = policy_rows(found, labelled(found, summary_rows(found)))
    assert {row["label"]: row["beats_distance"] for row in rows} == {
        "distance": "",
        "recall": "yes",
        "path": "no difference shown",
        "random": "no",
    }


def test_logs_of_ones_own_are_named_after_the_first_and_the_last(tmp_path: Path) -> None:
    drives = tuple(replace(made_up_drive(0), path=tmp_path / f"{day}.framelog") for day in "ab")
    assert DriveSet.of(drives).name == "a-to-b"
    assert DriveSet.of((made_up_drive(0), made_up_drive(1))).name == Path.cwd().name


def test_policies_run_on_different_sessions_are_not_compared(plan: Plan, tmp_path: Path) -> None:
    first, second = plan.folds[0].held_out, plan.folds[1].held_out
    assert len(first) == len(second)
    run = dict.fromkeys(first, ("path-near", "oracle", "bandit"))
    run |= dict.fromkeys(second, ("distance", "recall"))
    found = collect(with_runs(plan, tmp_path / "work", "memo", run))
    assert {one.policy for one in found.memo} == {"path-near", "oracle", "bandit"}
    assert {tuple(k.session for k in one.sessions) for one in found.memo.values()} == {first}
    assert {one.policy: count for one, count in found.left_out.items()} == {
        "distance": len(second),
        "recall": len(second),
    }


def test_one_policy_guided_in_another_fold_hides_no_other(plan: Plan, tmp_path: Path) -> None:
    first, second = plan.folds[0].held_out, plan.folds[1].held_out
    run = dict.fromkeys(first, ("path-near", "distance", "recall")) | dict.fromkeys(
        second, ("recall",)
    )
    found = collect(with_runs(plan, tmp_path / "work", "live", run))
    assert {one.policy for one in found.live} == {"path-near", "distance", "recall"}
    assert {tuple(k.session for k in one.sessions) for one in found.live.values()} == {first}


def test_what_stands_twice_in_a_file_counts_once(plan: Plan, tmp_path: Path) -> None:
    run = dict.fromkeys(plan.folds[0].held_out, ("path-near", "path-near"))
    found = collect(with_runs(plan, tmp_path / "work", "memo", run))
    (result,) = found.memo.values()
    assert tuple(one.session for one in result.sessions) == plan.folds[0].held_out


def test_results_without_the_record_of_their_map_are_told(plan: Plan, tmp_path: Path) -> None:
    work = tmp_path / "work"
    shutil.copytree(plan.work, work)
    record = plan.map_path(plan.folds[0]).with_suffix(".json").name
    (work / record).write_text('{"sessions": [{"nam')
    with pytest.raises(InputError, match=f"{record} does not show .* remove both"):
        collect(replace(plan, work=work))
    (work / record).unlink()
    with pytest.raises(InputError, match=f"{record} has 0 sessions"):
        collect(replace(plan, work=work))


def test_a_damaged_file_of_results_counts_as_not_run(plan: Plan, tmp_path: Path) -> None:
    whole = plan.runs_path(0, "live" if 0 in plan.folds[0].held_out else "memo").read_bytes()
    rng, path = np.random.default_rng(0), tmp_path / "runs.npz"
    refused = 0
    for _ in range(300):
        damaged = bytearray(whole)
        for at in rng.integers(len(whole), size=4):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        refused += read_runs(path) is None
    assert refused > 100


def test_nothing_run_is_told_rather_than_reported(plan: Plan, tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    with pytest.raises(InputError, match="nothing was run"):
        write_report(tmp_path / "out", [replace(plan, work=tmp_path / "work")])
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_an_error_of_one_line(
    plan: Plan, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(InputError, match="cannot be written"):
        write_report(tmp_path / "file" / "out", [plan])
    with pytest.raises(InputError, match="cannot be written"):
        make_plan(plan.drives, plan.settings, plan.options, tmp_path / "file" / "work")


@pytest.mark.long
def test_more_rounds_alone_are_reported_too(plan: Plan, tmp_path: Path) -> None:
    work = tmp_path / "work"
    work.mkdir()
    options = replace(
        plan.options, policies=("distance", "path-near"), lanes=(1, 2), rounds=(2,), map_sizes=False
    )
    twice = replace(plan, work=work, options=options)
    for fold in plan.folds:
        source = plan.map_path(fold).with_suffix(".json")
        (work / source.name).write_bytes(source.read_bytes())
        for session in fold.held_out:
            runs = made_up_runs(session, sweep(options.policies, options.lanes, options.rounds))
            write_runs(twice.runs_path(session, "memo"), runs)
    write_report(tmp_path / "out", [twice])
    text = (tmp_path / "out" / "report.md").read_text()
    assert "Np = 2, Nr = 2, T = 10" in text
    assert "| distance | " in text
