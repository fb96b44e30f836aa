"""Everything that an evaluation of ranking policies leaves in its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from engram.evaluation.building import write_json
from engram.evaluation.running import Plan
from engram.evaluation.summary import collect
from engram.evaluation.tables import session_rows, summary_rows, write_csv


def write_report(out: Path, plans: Sequence[Plan]) -> list[Path]:
    """Tables and the resolved configuration of some campaigns, from what was run of them.

    Args:
        out: the folder; made if need be, files in it are replaced.
        plans: one per campaign.

    Returns:
        The files written.
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
    return [out / name for name in (*tables, "configuration.json")]
