"""Everything that a fleet study leaves in its folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from engram.fleet.build.orders import order_costs
from engram.measures import Drive, failure, longest_gap_m, route_m, route_not_localised
from engram.robot.settings import Settings
from engram_lab.studies.building import BuiltSession
from engram_lab.studies.fleet.experiments import SHARED, SINGLE, merged_name, pair_merges
from engram_lab.studies.fleet.figures import draw_fleet_figures
from engram_lab.studies.fleet.plan import FORAY_POLICIES, ROBOTS, VERBS, FleetPlan, read_json
from engram_lab.studies.fleet.results import (
    ArmResult,
    FoldResult,
    InField,
    Parallel,
    Time,
    Trials,
    slowest,
    total,
)
from engram_lab.studies.fleet.steps import (
    AS_TOD,
    AS_TOD_PATHS,
    COPY,
    QUARTER,
    TENTH,
    TOD,
    TOD_PATHS,
    Counts,
    TriedDownload,
    stages_path,
)
from engram_lab.studies.in_force import exceptions, in_words, unused
from engram_lab.studies.in_force import rows as in_force_rows
from engram_lab.studies.pages import (
    COMPARED,
    Row,
    chosen,
    compared_drives,
    make_folder,
    table,
    write_study,
)
from engram_lab.studies.summary import ConfigurationResult, SessionResult


def comparison_rows(arm: ArmResult) -> list[Row]:
    """All of one arm; of the requested experiments."""
    about = {"campaign": arm.plan.drives.name, "arm": arm.arm.letter}
    of = {7: _building, 8: _sharing, 9: _downloads, 10: _orders}
    return [
        {**about, "experiment": number, **row}
        for number, rows in of.items()
        if arm.asked(number)
        for row in rows(arm)
    ]


def _building(arm: ArmResult) -> Iterator[Row]:
    """Fig. 7."""
    main = arm.plan.options.groups
    for groups in arm.plan.group_counts(arm.plan.folds[0]):
        whole = _whole(arm, groups)
        if not whole:
            continue
        single = [fold.time_of(fold.single() or []) for fold, _ in whole]
        what = f"{groups} groups, merged one after another, ÷ one agent"
        paper = ("29.36 %", "67.57 %", "21.97 against 32.03 %") if groups == main else ("", "", "")
        yield from _times(what, [built.time for _, built in whole], single, paper[0])
        alone = [slowest(built.group_times) for _, built in whole]
        yield from _times(f"{groups} groups: the slowest ÷ one agent", alone, single)
        agents = sum((fold.single() or [])[-1].nodes for fold, _ in whole)
        merged = sum(built.nodes for _, built in whole)
        yield _ratio(f"{what}: nodes", merged, agents, paper[1])
        name = merged_name(groups, groups - 1)
        yield from _held_out_pairs(
            arm, f"{groups} groups merged against one agent", name, SINGLE, paper[2]
        )
        pairwise = [built.pairwise_time for _, built in whole if built.pairwise_time is not None]
        if groups == main and len(pairwise) == len(whole):
            what = f"{groups} groups, merged as a pairwise tree, ÷ one agent"
            yield from _times(what, pairwise, single)
            tree = sum(built.pairs[-1][1].nodes for _, built in whole)
            yield _ratio(f"{what}: nodes", tree, agents)
            name = pair_merges(groups)[-1].name
            yield from _held_out_pairs(arm, "pairwise tree against one agent", name, SINGLE)


def _whole(arm: ArmResult, groups: int) -> list[tuple[FoldResult, Parallel]]:
    """Folds in which both ways of building are complete."""
    found = [(fold, fold.parallel(groups)) for fold in arm.folds if fold.single() is not None]
    return [(fold, built) for fold, built in found if built is not None]


def _times(what: str, above: Sequence[Time], below: Sequence[Time], paper: str = "") -> list[Row]:
    a, b = total(above), total(below)
    return [
        _ratio(f"{what}: time by counts", a.counted_s, b.counted_s, paper),
        _ratio(f"{what}: time by the clock", a.wall_s, b.wall_s),
    ]


def _ratio(what: str, part: float | None, whole: float | None, paper: str = "") -> Row:
    """One by the other; nothing where either was not measured, or nothing was counted."""
    known = None if part is None or not whole else part / whole
    return {"what": what, "paper": paper, "ratio": known}


def _sharing(arm: ArmResult) -> Iterator[Row]:
    """Fig. 8."""
    for robot in ROBOTS:
        yield from _held_out_pairs(
            arm, f"shared map against {robot}'s own", SHARED, robot, "better"
        )


def _held_out_pairs(arm: ArmResult, what: str, a: str, b: str, paper: str = "") -> Iterator[Row]:
    found = arm.held_out(a, b)
    if found is not None:
        ours, theirs = (one.drives for one in found)
        yield compared_drives(what, ours, theirs, arm.plan.options.seed, paper)


def _downloads(arm: ArmResult) -> Iterator[Row]:
    """Fig. 9."""
    seed, copied = arm.plan.options.seed, arm.forays(COPY)
    for policy, paper in (
        (TOD, "81.77 and 79.57 % (united)"),
        (TOD_PATHS, "74.56 and 66.57 % (united)"),
    ):
        driven, taken = arm.forays(policy), arm.downloads(policy)
        if not driven or len(driven) != len(copied):
            continue
        whole = sum(one.of_nodes for one in taken)
        what = f"second foray in one `{policy}` download"
        yield _ratio(f"{what}: nodes taken along", sum(one.nodes for one in taken), whole)
        united = sum(one.united for one in taken)
        yield _ratio(f"{what}: united with the robot's own", united, whole, paper)
        others = sum(one.policy != policy for one in taken)
        a, b = ([one.drive for one in some] for some in (driven, copied))
        row = compared_drives(f"{what} against `{COPY}`", a, b, seed, "slightly worse")
        yield {**row, "asked_for_more": others}
    trials = arm.trials()
    for name, other in (
        *((one, COPY) for one in (TOD, TOD_PATHS, QUARTER, TENTH)),
        (AS_TOD, TOD),
        (AS_TOD_PATHS, TOD_PATHS),
    ):
        others_of = {drive.session.id: one for drive, one in trials.get(other, [])}
        pairs = [
            (one, others_of[drive.session.id])
            for drive, one in trials.get(name, [])
            if drive.session.id in others_of
        ]
        if pairs:
            a, b = ([pair[k].drive for pair in pairs] for k in (0, 1))
            yield compared_drives(f"`{name}` against `{other}`, each for its drive", a, b, seed)


def _orders(arm: ArmResult) -> Iterator[Row]:
    """Fig. 10."""
    fold = arm.folds[0]
    found = fold.orders()
    if found is None:
        return
    count = f"{len(found['orders'])} orders of {len(fold.order_groups())} groups"
    for what, part, whole, paper in _order_times(fold, found):
        yield _ratio(f"{count}: {what}", part, whole, paper)
    driven = fold.held_out("orders-sequential")
    if driven and found["orders"]:
        row = {"what": "chosen order against one agent with the same drives"}
        missed = sum(one.drive.step_m[~one.drive.matched].sum() for one in driven)
        route = sum(one.drive.step_m.sum() for one in driven)
        chosen = found["orders"][0]["reported_missed"]
        yield {**row, "share_a": chosen, "share_b": float(missed / route), "drives": len(driven)}


def _order_times(
    fold: FoldResult, found: dict[str, Any]
) -> Iterator[tuple[str, float | None, float | None, str]]:
    """By (8), against a prefix tree, and one order really built; None for what is not timed."""
    groups = fold.order_groups()
    groups_s = total(fold.time_of(one) for one in groups).counted_s
    merges_s = fold.counted(
        Counts(found["replayed"], found["attempts"], found["proposed"], found["lookups"])
    )
    names = (
        "by (8) ÷ sequential", "as a prefix tree ÷ sequential",
        "as a prefix tree ÷ a sequential prefix tree",
        "later groups of one that was built ÷ (k − 1)·T_G of (8)",
    )  # fmt: skip
    if groups_s is None or merges_s is None:
        yield from ((name, None, None, "") for name in names)
        return
    group_s, merge_s = groups_s / len(groups), merges_s / max(found["merges"], 1)
    costs = order_costs(len(groups), group_s, merge_s, found["copy_s"] / max(found["copies"], 1))
    built = fold.sequential()
    rest_s = fold.time_of(built[len(groups[0]) :]).counted_s if built else None
    yield names[0], costs.model_s, costs.sequential_s, "22.44 %"
    yield names[1], costs.tree_s, costs.sequential_s, ""
    yield names[2], costs.tree_s, costs.sequential_tree_s, ""
    yield names[3], rest_s, (len(groups) - 1) * group_s, "100 % (assumed)"


_AT_M = (5.0, 10.0, 20.0)


def fleet_rows(arm: ArmResult) -> list[Row]:
    """All rows of one arm."""
    rows: list[Row] = []
    for fold in arm.folds:
        rows += _building_rows(fold)
        rows += _sharing_rows(fold)
        rows += _foray_rows(str(fold.fold.number), _forays(fold))
        rows += _trial_rows(str(fold.fold.number), _flat(fold.trials()))
        rows += _order_rows(fold)
    rows += _pooled_rows(arm)
    return _asked(arm, rows)


def session_rows(arm: ArmResult) -> list[Row]:
    """One row per held-out drive in each map and download: what intervals are drawn from."""
    rows: list[Row] = []
    drives = arm.plan.drives.drives
    for fold in arm.folds:
        number = str(fold.fold.number)
        for experiment, what, name in _shown(fold):
            for one in fold.held_out(name):
                about = _row(experiment, number, what) | {"drive": drives[one.session].name}
                rows.append(about | _held_out_rows([one]))
        for drive, trial in chain.from_iterable(fold.trials().values()):
            rows += [{**row, "drive": drive.name} for row in _trial_rows(number, [trial])]
    return _asked(arm, rows)


def _asked(arm: ArmResult, rows: Sequence[Row]) -> list[Row]:
    """Those of the requested experiments, with what they are about."""
    about = {
        "campaign": arm.plan.drives.name,
        "arm": arm.arm.letter,
        "policy": arm.arm.driving.ranking,
        "attempts": arm.configuration.budget.attempts if arm.arm.letter != "C" else "all",
    }
    return [{**about, **row} for row in rows if arm.asked(row["experiment"])]


def _shown(fold: FoldResult) -> Iterator[tuple[int, str, str]]:
    """Experiment, words and name of the maps that held-out drives are localised in."""
    yield 7, SINGLE, SINGLE
    for groups in fold.plan.group_counts(fold.fold):
        yield 7, f"{groups} groups", merged_name(groups, groups - 1)
        yield 7, f"{groups} groups, pairwise", pair_merges(groups)[-1].name
    for name in (*ROBOTS, SHARED):
        yield 8, name, name
    yield 10, "one order built sequentially", "orders-sequential"


def order_rows(arm: ArmResult) -> list[Row]:
    """One row per order of merging."""
    found = arm.folds[0].orders()
    if found is None or not arm.asked(10):
        return []
    return [
        {
            "campaign": arm.plan.drives.name,
            "arm": arm.arm.letter,
            "order": "-".join(map(str, one["order"])),
            "chosen": one["order"] == found["order"],
            "nodes": one["nodes"],
            "validation_area_m": one["area_m"],
            **{f"validation_p_gt_{at}m": p for at, p in one["at_m"].items()},
            **{f"p_gt_{at:g}m": one["reported"][round(2 * at)] for at in _AT_M},
            "share_not_localised": one["reported_missed"],
        }
        for one in found["orders"]
    ]


def _building_rows(fold: FoldResult) -> Iterator[Row]:
    """Fig. 7."""
    number = str(fold.fold.number)
    single = fold.single()
    if single is not None:
        yield {
            **_row(7, number, SINGLE),
            **_mapped(single),
            **_time(fold.time_of(single)),
            **_held_out_rows(fold.held_out(SINGLE)),
        }
    for groups in fold.plan.group_counts(fold.fold):
        built = fold.parallel(groups)
        if built is None:
            continue
        merged, merges = merged_name(groups, groups - 1), total(built.merge_times)
        logs = sum(len(one) for one in built.groups)
        yield {
            **_row(7, number, f"{groups} groups"),
            "logs": logs,
            "nodes": built.nodes,
            **_time(built.time),
            "merges_counted_s": merges.counted_s,
            "merges_wall_s": merges.wall_s,
            **_held_out_rows(fold.held_out(merged)),
        }
        pairwise = built.pairwise_time
        if pairwise is not None:
            name = pair_merges(groups)[-1].name
            yield {
                **_row(7, number, f"{groups} groups, pairwise"),
                "logs": logs,
                "nodes": fold.nodes(name),
                **_time(pairwise),
                **_held_out_rows(fold.held_out(name)),
            }


def _sharing_rows(fold: FoldResult) -> Iterator[Row]:
    """Fig. 8."""
    found = {name: fold.held_out(name) for name in (*ROBOTS, SHARED)}
    if all(found.values()):
        for name, held_out in found.items():
            row = _row(8, str(fold.fold.number), name)
            yield {**row, "nodes": fold.nodes(name), **_held_out_rows(held_out)}


def _forays(fold: FoldResult) -> list[InField]:
    return [one for some in fold.forays().values() for one in some]


def _foray_rows(number: str, forays: Sequence[InField]) -> Iterator[Row]:
    """Fig. 9: second forays in the field."""
    for policy in FORAY_POLICIES:
        some = [one for one in forays if one.policy == policy]
        if not some:
            continue
        frames = sum(one.frames for one in some)
        counted_s = total(one.time for one in some).counted_s
        yield {
            **_row(9, number, f"foray in {policy}"),
            "logs": len(some),
            "nodes": float(np.mean([one.nodes for one in some])),
            "ms_per_frame": sum(one.ms * one.frames for one in some) / frames,
            "counted_ms_per_frame": None if counted_s is None else 1e3 * counted_s / frames,
            **_failure([one.drive for one in some]),
        }


def _flat(trials: Trials) -> list[TriedDownload]:
    return [one for _, one in chain.from_iterable(trials.values())]


def _trial_rows(number: str, trials: Sequence[TriedDownload]) -> Iterator[Row]:
    """Fig. 9: downloads for the hours of held-out drives."""
    for name in dict.fromkeys(one.name for one in trials):
        some = [one for one in trials if one.name == name]
        lengths = np.array([route_m([one.drive]) for one in some])
        promised = np.array([one.expected_missed for one in some])
        yield {
            **_row(9, number, f"held out in {name}"),
            "nodes": float(np.mean([one.nodes for one in some])),
            "share_of_nodes": float(np.mean([one.nodes / one.of_nodes for one in some])),
            "united_share_of_nodes": float(np.mean([one.united / one.of_nodes for one in some])),
            "size_bytes": float(np.mean([one.size_bytes for one in some])),
            "ms_per_frame": float(np.mean([one.ms for one in some])),
            "lookup_ms_per_frame": float(np.mean([one.lookup_ms for one in some])),
            "lookups": sum(one.lookups for one in some),
            "expected_missed": float(promised @ lengths / lengths.sum()),
            **_failure([one.drive for one in some]),
        }


def _order_rows(fold: FoldResult) -> Iterator[Row]:
    """Fig. 10: the spread over the orders, on the sessions that chose nothing."""
    found = fold.orders()
    if found is None:
        return
    number = str(fold.fold.number)
    curves = np.array([one["reported"] for one in found["orders"]])
    missed = np.array([one["reported_missed"] for one in found["orders"]])
    for name, statistic in (("least", np.min), ("median", np.median), ("most", np.max)):
        yield {
            **_row(10, number, f"{name} of {len(curves)} orders"),
            "share_not_localised": float(statistic(missed)),
            **{f"p_gt_{at:g}m": float(statistic(curves[:, round(2 * at)])) for at in _AT_M},
        }
    yield {
        **_row(10, number, "best order, chosen on validation"),
        "nodes": found["orders"][0]["nodes"],
        "share_not_localised": float(missed[0]),
        **{f"p_gt_{at:g}m": float(curves[0, round(2 * at)]) for at in _AT_M},
    }
    built = fold.sequential()
    if built:
        yield {
            **_row(10, number, "one order built sequentially"),
            **_mapped(built),
            **_time(fold.time_of(built)),
            **_held_out_rows(fold.held_out("orders-sequential")),
        }


def _pooled_rows(arm: ArmResult) -> Iterator[Row]:
    groups = arm.plan.options.groups
    pairs = pair_merges(groups)[-1].name
    for experiment, name, what in (
        (7, SINGLE, SINGLE),
        (7, merged_name(groups, groups - 1), f"{groups} groups"),
        (7, pairs, f"{groups} groups, pairwise"),
    ):
        found = arm.held_out(name)
        if found is not None:
            yield {**_row(experiment, "all", what), **_result(found[0])}
    maps = (*ROBOTS, SHARED)
    for name, result in zip(maps, arm.held_out(*maps) or (), strict=False):
        yield {**_row(8, "all", name), **_result(result)}
    yield from _foray_rows("all", [one for policy in FORAY_POLICIES for one in arm.forays(policy)])
    yield from _trial_rows("all", _flat(arm.trials()))


def _row(experiment: int, fold: str, name: str) -> Row:
    return {"experiment": experiment, "fold": fold, "map": name}


def _mapped(sessions: Sequence[BuiltSession]) -> Row:
    return {
        "logs": len(sessions),
        "nodes": sessions[-1].nodes,
        "frames": sum(one.frames for one in sessions),
        "match_attempts": sum(one.attempts for one in sessions),
        "proposed_attempts": sum(one.proposed for one in sessions),
        "lookups": sum(one.lookups for one in sessions),
    }


def _time(time: Time) -> Row:
    return {"counted_s": time.counted_s, "wall_s": time.wall_s}


def _held_out_rows(sessions: Sequence[SessionResult]) -> Row:
    if not sessions:
        return {}
    drives = [one.drive for one in sessions]
    frames = sum(one.frames for one in sessions)
    return {
        **_failure(drives),
        "attempts_per_frame": sum(one.attempts for one in sessions) / frames,
        "false_successes": sum(int(one.errors.false.sum()) for one in sessions),
    }


def _result(found: ConfigurationResult) -> Row:
    return _held_out_rows(found.sessions)


def _failure(drives: Sequence[Drive]) -> Row:
    return {
        "sessions": len(drives),
        "driven_m": route_m(drives),
        "share_not_localised": route_not_localised(drives),
        **{f"p_gt_{at:g}m": float(failure(drives, at)) for at in _AT_M},
        "longest_gap_m": longest_gap_m(drives),
    }


_TITLES = {
    7: "Building side by side (Fig. 7)",
    8: "Sharing (Fig. 8)",
    9: "Taking a part (Fig. 9)",
    10: "Orders of merging (Fig. 10)",
}
# What stands beside every table, of each kind of step.
_BUDGET = {"drive.ranking": "policy", "drive.lanes": "Np", "drive.rounds": "Nr"}
_SHOWN = {
    "maps": {**_BUDGET, "mapper.sure_inliers": "sure inliers"},
    "merges": {
        "merge.ranking": "policy",
        "merge.lanes": "Np",
        "merge.rounds": "Nr",
        "merge.relocaliser": "relocaliser",
        "merge.sure_inliers": "sure inliers",
        "merge.unit": "unit",
        "merge.seed": "seed",
    },
    "held out": _BUDGET,
    "downloads": {
        "download.window_min": "window min",
        "download.epoch_min": "epoch min",
        "download.best_percent": "best %",
    },
    "orders": {"build.max_gap_m": "judged at m", "build.estimator": "over"},
}
# Tables of the settings that the study reads.
_USED = {one.name for one in fields(Settings)} | set(VERBS)
_COLUMNS = {
    "arm": "arm",
    "map": "map",
    "nodes": "nodes",
    "share_of_nodes": "of all nodes",
    "united_share_of_nodes": "united with the robot's own",
    "share_not_localised": "route not localised",
    "expected_missed": "forecast",
    "p_gt_5m": "P(> 5 m)",
    "p_gt_10m": "P(> 10 m)",
    "ms_per_frame": "ms per frame",
    "sessions": "drives",
}


def write_fleet_report(out: Path, plans: Sequence[FleetPlan]) -> list[Path]:
    """Tables, comparisons, figures, the page and the resolved configuration, of what was run.

    Args:
        out: the folder; made if need be, files in it are replaced.
        plans: one per campaign.

    Returns:
        The files written.

    Raises:
        StorageFullError, InputError: the folder cannot be written.
        MissingExtraError: Matplotlib is not installed; the tables are written by then.
    """
    arms = [ArmResult(plan, arm) for plan in plans for arm in plan.arms]
    make_folder(out)
    tables = {
        "in_force": [row for arm in arms for row in _in_force_rows(arm)],
        "summary": [row for arm in arms for row in fleet_rows(arm)],
        "sessions": [row for arm in arms for row in session_rows(arm)],
        "orders": [row for arm in arms for row in order_rows(arm)],
        "comparisons": [row for arm in arms for row in comparison_rows(arm)],
    }
    return write_study(
        out,
        tables,
        _page(arms, tables["summary"], tables["comparisons"]),
        [_configuration(plan) for plan in plans],
        lambda folder: draw_fleet_figures(folder, arms),
    )


def _page(
    arms: Sequence[ArmResult], rows: Sequence[Row], comparisons: Sequence[Row]
) -> Iterator[str]:
    for name in dict.fromkeys(arm.plan.drives.name for arm in arms):
        own = [arm for arm in arms if arm.plan.drives.name == name]
        yield from (f"## {name}", "", _protocol(own[0]), "")
        yield from (_medians(arm) for arm in own if arm.stages is not None)
        yield from (line for arm in own for line in _exceptions(arm))
        yield from unused(own[0].plan.tables, _USED)
        beside = "\n".join(line for arm in own if (line := _in_words(arm)))
        for number, title in _TITLES.items():
            # The orders are tried on one fold; all else is pooled.
            fold = "0" if number == 10 else "all"
            shown = chosen(rows, campaign=name, experiment=number, fold=fold)
            claims = chosen(comparisons, campaign=name, experiment=number)
            if shown or claims:
                yield from ("", f"### {title}", "")
                columns = {
                    key: words
                    for key, words in _COLUMNS.items()
                    if any(row.get(key) is not None for row in shown)
                }
                yield from table(shown, columns, beside)
                yield from table(claims, {"arm": "arm", **COMPARED, "drives": "drives"}, beside)


def _in_force_rows(arm: ArmResult) -> Iterator[Row]:
    """What each kind of step of an arm ran by."""
    for name, known in arm.in_force().items():
        about = {"campaign": arm.plan.drives.name, "arm": arm.arm.letter, "of": name}
        yield from in_force_rows(known, arm.plan.tables, about)


def _exceptions(arm: ArmResult) -> Iterator[str]:
    """What of the settings does not hold in an arm."""
    for name, known in arm.in_force().items():
        for line in exceptions(known, arm.plan.tables):
            yield f"- Arm {arm.arm.letter}, {name}, {line}."


def _in_words(arm: ArmResult) -> str:
    """What is in force in an arm, with its rows; empty where nothing was run."""
    known = arm.in_force()
    parts = [in_words(known.get("held out", {}))]
    for name, keys in _SHOWN.items():
        some = known.get(name, {})
        told = ", ".join(f"{words} {some[key]}" for key, words in keys.items() if key in some)
        parts += [f"{name.capitalize()}: {told}."] if told else []
    told = " ".join(filter(None, parts))
    return f"- Arm {arm.arm.letter}. {told}" if told else ""


def _protocol(arm: ArmResult) -> str:
    """How many logs there were: [G16]'s protocols are scaled to them."""
    fold = arm.plan.folds[0]
    protocol, groups = arm.plan.protocol(fold), arm.plan.groups(fold, arm.plan.options.groups)
    return (
        f"{len(arm.plan.drives.drives)} drives, {arm.plan.options.folds} folds, "
        f"{len(fold.training)} training drives in the first; {len(groups)} groups of "
        f"{len(groups[-1])} to {len(groups[0])} (Fig. 7); forays of {protocol.foray} (7 in the "
        f"paper; Figs. 8 and 9); groups of {protocol.group} (9 in the paper) for the orders, "
        f"chosen on {protocol.validation} validation drives (Fig. 10). Saving, front-end and "
        "odometry are not counted: every drive passes through them once whichever way a map is "
        "built. Shares are of the route that is not localised; intervals are 90 % over sessions."
    )


def _medians(arm: ArmResult) -> str:
    assert arm.stages is not None
    return (
        f"- Arm {arm.arm.letter}, {arm.arm.words}: medians on one core {arm.stages.frame_ms:.2f} "
        f"ms a frame, {arm.stages.attempt_ms:.2f} ms an attempt, {arm.stages.proposed_ms:.2f} ms "
        f"one of a lost robot at a proposed node, {arm.stages.lookup_ms:.2f} ms a look-up."
    )


def _configuration(plan: FleetPlan) -> dict[str, object]:
    """With the medians that counts are turned into times by."""
    paths = {arm.letter: stages_path(plan, arm) for arm in plan.arms}
    stages = {letter: read_json(path) for letter, path in paths.items() if path.exists()}
    return {**plan.configuration(), "stages_ms": stages}
