"""`engram bench`."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from engram.cli import options

_WORLD = "world"


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
      engram bench --only world    (how hard the simulated town is; 3 to 5 minutes)
    """
    from rich.console import Console

    from engram_lab.bench import BenchReport, run_bench
    from engram_lab.bench.world import WorldReport, measure_world

    names = only.split(",") if only else None
    stages = None if names is None else [name for name in names if name != _WORLD]
    found: list[BenchReport | WorldReport] = []
    with Console(stderr=True).status("") as status:
        if stages is None or stages:
            found.append(
                run_bench(
                    stages,
                    repeats=repeats,
                    progress=lambda stage, done, of: status.update(f"{stage} ({done + 1} of {of})"),
                )
            )
        if names is not None and _WORLD in names:
            found.append(measure_world(advance=status.update))
    if not as_json:
        for report in found:
            Console().print(report.table())
        return
    parts = [{_WORLD: r.to_dict()} if isinstance(r, WorldReport) else r.to_dict() for r in found]
    print(json.dumps({key: value for part in parts for key, value in part.items()}))
