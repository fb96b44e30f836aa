"""Everything that an evaluation of ranking policies leaves in its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from engram.evaluation.building import write_json
from engram.evaluation.claims import claims_page
from engram.evaluation.figures import draw_figures
from engram.evaluation.running import Plan
from engram.evaluation.summary import collect
from engram.evaluation.tables import session_rows, summary_rows, write_csv


def write_report(out: Path, plans: Sequence[Plan]) -> list[Path]:
    """Tables, figures and the resolved configuration, from what was run of some campaigns.

    Args:
        out: the folder; made if need be, files in it are replaced.
        plans: one per campaign.

    Returns:
        The files written.

    Raises:
        MissingExtraError: Matplotlib is not installed; the tables are written by then.
    """
    out.mkdir(parents=True, exist_ok=True)
    campaigns = [collect(plan) for plan in plans]
    tables = {
        "summary.csv": [row for one in campaigns for row in summary_rows(one)],
        "sessions.csv": [row for one in campaigns for row in session_rows(one)],
    }
    for name, rows in tables.items():
        write_csv(out / name, rows)
    write_json(out / "configuration.json", [plan.configuration() for plan in plans])
    (out / "claims.md").write_text(claims_page(campaigns), encoding="utf-8")
    files = [out / name for name in (*tables, "configuration.json", "claims.md")]
    return files + draw_figures(out, campaigns)
