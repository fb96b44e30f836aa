"""`engram demo`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options

if TYPE_CHECKING:
    from rich.table import Table

    from engram_lab.demo import DemoReport


def demo(
    *,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Where logs, map and pictures go.")
    ] = Path("demo"),
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes that render.")] = 2,
    as_json: options.Json = False,
) -> None:
    """Drive a small simulated town with two robots, map it, and localise another drive in it.

    \b
    Examples:
      engram demo
      engram demo --out /tmp/demo --workers 4
    """
    from engram.cli.progress import progress
    from engram_lab.demo import run_demo

    report = run_demo(out, progress, workers)
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        _tell(report)


def _found(report: DemoReport) -> Table:
    """How the last drive was localised, by policy and budget."""
    from rich.table import Table

    table = Table(title=f"Then: {report.conditions[-1]}")
    columns = ("policy", "attempts allowed", "made a frame", "localised", "longest gap, m")
    for column in columns:
        table.add_column(column, justify="left" if column == "policy" else "right")
    for policy, summaries in report.localised.items():
        for most, summary in summaries.items():
            table.add_row(
                policy,
                str(most),
                f"{summary['attempts_per_frame']:.2f}",
                f"{summary['share_localised']:.0%}",
                f"{summary['longest_gap_m']:.1f}",
            )
    return table


def _tell(report: DemoReport) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    grown = Table(title="The map grows where a drive does not know the place")
    for column in ("drive", "localised", "new nodes"):
        grown.add_column(column, justify="left" if column == "drive" else "right")
    for condition, mapped in zip(report.conditions, report.mapped, strict=False):
        share = mapped.to_dict()["share_localised"]
        grown.add_row(condition, f"{share:.0%}", str(mapped.saved))
    console.print(grown)
    console.print(_found(report))
    console.print(
        f"In {report.out}: one_place.png, the same place in six conditions; matches_path-near_4/, "
        "live image and node side by side with their inliers joined; map_from_above.png, "
        "experiences in colour; attempts.png, what each frame cost until it matched. `distance` "
        "tries the nearest node first, `path-near` one that went together in earlier drives with "
        "those that matched just now: the more experiences a place has, the more that saves."
    )
