"""`engram bench`."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from engram.cli import options


def bench(
    *,
    only: Annotated[
        str | None, typer.Option("--only", metavar="STAGES", help="Stages, joined by commas.")
    ] = None,
    repeats: Annotated[int, typer.Option("--repeats", min=1, help="Runs of each stage.")] = 200,
    as_json: options.Json = False,
) -> None:
    """Time each stage on one core, in memory, beside a plain OpenCV pipeline in the same run.

    \b
    Examples:
      engram bench
      engram bench --only frontend_odometry_512,attempt_512 --json
    """
    from rich.console import Console

    from engram.bench import run_bench

    names = only.split(",") if only else None
    with Console(stderr=True).status("") as status:
        report = run_bench(
            names,
            repeats=repeats,
            progress=lambda stage, done, of: status.update(f"{stage} ({done + 1} of {of})"),
        )
    if as_json:
        print(json.dumps(report.to_dict()))
        return
    Console().print(report.table())
