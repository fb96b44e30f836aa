"""Everything that a fleet study leaves in its folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path

from engram.robot import Settings
from engram_lab.studies.fleet.comparisons import comparison_rows
from engram_lab.studies.fleet.figures import draw_fleet_figures
from engram_lab.studies.fleet.plan import VERBS, FleetPlan
from engram_lab.studies.fleet.records import read_json
from engram_lab.studies.fleet.results import ArmResult
from engram_lab.studies.fleet.stages import stages_path
from engram_lab.studies.fleet.tables import fleet_rows, order_rows, session_rows
from engram_lab.studies.in_force import exceptions, in_words, unused
from engram_lab.studies.in_force import rows as in_force_rows
from engram_lab.studies.pages import COMPARED, Row, chosen, make_folder, table, write_study

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
