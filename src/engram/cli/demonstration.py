"""`engram demo`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options

if TYPE_CHECKING:
    from engram.demo import DemoReport


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
    from engram.demo import run_demo

    report = run_demo(out, progress, workers)
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        _tell(report)


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
    found = Table(title=f"Then: {report.conditions[-1]}, up to four attempts a frame")
    for column in ("policy", "localised", "attempts a frame", "longest gap, m"):
        found.add_column(column, justify="left" if column == "policy" else "right")
    for policy, summary in report.localised.items():
        found.add_row(
            policy,
            f"{summary['share_localised']:.0%}",
            f"{summary['attempts_per_frame']:.2f}",
            f"{summary['longest_gap_m']:.1f}",
        )
    console.print(found)
    console.print(
        f"In {report.out}: one_place.png, the same place in six conditions; matches_path/, live "
        "image and node side by side with their inliers joined; map_from_above.png, experiences "
        "in colour; attempts.png, what each frame cost until it matched. `distance` tries the "
        "nearest node first, `path` one that went together in earlier drives with those that "
        "matched just now: the more experiences a place has, the more that saves."
    )
