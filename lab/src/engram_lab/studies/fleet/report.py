"""Everything that a fleet study leaves in its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from engram_lab.studies.building import write_json
from engram_lab.studies.fleet.claims import fleet_claims_page
from engram_lab.studies.fleet.figures import draw_fleet_figures
from engram_lab.studies.fleet.plan import FleetPlan
from engram_lab.studies.fleet.records import read_json
from engram_lab.studies.fleet.results import ArmResult
from engram_lab.studies.fleet.stages import stages_path
from engram_lab.studies.fleet.tables import fleet_rows, order_rows, session_rows
from engram_lab.studies.tables import write_csv
from engram_lab.studies.writing import writing


def write_fleet_report(out: Path, plans: Sequence[FleetPlan]) -> list[Path]:
    """Tables, figures, claims and the resolved configuration, from what was run so far.

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
    names = ("summary.csv", "sessions.csv", "orders.csv", "configuration.json", "claims.md")
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        write_csv(out / "summary.csv", [row for arm in arms for row in fleet_rows(arm)])
        write_csv(out / "sessions.csv", [row for arm in arms for row in session_rows(arm)])
        write_csv(out / "orders.csv", [row for arm in arms for row in order_rows(arm)])
        write_json(out / "configuration.json", [_configuration(plan) for plan in plans])
        (out / "claims.md").write_text(fleet_claims_page(arms), encoding="utf-8")
        return [out / name for name in names] + draw_fleet_figures(out, arms)


def _configuration(plan: FleetPlan) -> dict[str, object]:
    """With the medians that counts are turned into times by."""
    paths = {arm.letter: stages_path(plan, arm) for arm in plan.arms}
    stages = {letter: read_json(path) for letter, path in paths.items() if path.exists()}
    return {**plan.configuration(), "stages_ms": stages}
