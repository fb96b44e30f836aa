"""Everything that an evaluation of ranking policies leaves in its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from engram.errors import InputError
from engram_lab.studies.building import write_json
from engram_lab.studies.claims import claims_page
from engram_lab.studies.figures import draw_figures
from engram_lab.studies.running import Plan
from engram_lab.studies.summary import CampaignResult, collect
from engram_lab.studies.tables import session_rows, summary_rows, write_csv
from engram_lab.studies.writing import writing


def write_report(out: Path, plans: Sequence[Plan]) -> list[Path]:
    """Tables, figures and the resolved configuration, from what was run of some campaigns.

    Args:
        out: the folder; made if need be, files in it are replaced.
        plans: one per campaign.

    Returns:
        The files written.

    Raises:
        InputError: nothing was run of a campaign, or the folder cannot be written.
        StorageFullError: no space is left.
        MissingExtraError: Matplotlib is not installed; the tables are written by then.
    """
    campaigns = [_with_results(plan) for plan in plans]
    tables = {
        "summary.csv": [row for one in campaigns for row in summary_rows(one)],
        "sessions.csv": [row for one in campaigns for row in session_rows(one)],
    }
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        for name, rows in tables.items():
            write_csv(out / name, rows)
        write_json(out / "configuration.json", [plan.configuration() for plan in plans])
        (out / "claims.md").write_text(claims_page(campaigns), encoding="utf-8")
        files = [out / name for name in (*tables, "configuration.json", "claims.md")]
        return files + draw_figures(out, campaigns)


def _with_results(plan: Plan) -> CampaignResult:
    found = collect(plan)
    if not found.memo and not found.live:
        raise InputError(
            f"of {plan.drives.name} nothing was run with these options in {plan.work}; give "
            "--work, --folds, --seed and the settings as when it was run, or leave out "
            "--report-only"
        )
    return found
