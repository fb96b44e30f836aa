"""Everything that a fleet study leaves in its folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from engram_lab.studies.fleet.comparisons import comparison_rows
from engram_lab.studies.fleet.figures import draw_fleet_figures
from engram_lab.studies.fleet.plan import FleetPlan
from engram_lab.studies.fleet.records import read_json
from engram_lab.studies.fleet.results import ArmResult
from engram_lab.studies.fleet.stages import stages_path
from engram_lab.studies.fleet.tables import fleet_rows, order_rows, session_rows
from engram_lab.studies.pages import COMPARED, Row, chosen, make_folder, table, write_study

_TITLES = {
    7: "Building side by side (Fig. 7)",
    8: "Sharing (Fig. 8)",
    9: "Taking a part (Fig. 9)",
    10: "Orders of merging (Fig. 10)",
}
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
                yield from table(shown, columns)
                yield from table(claims, {"arm": "arm", **COMPARED, "drives": "drives"})


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
