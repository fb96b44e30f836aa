"""`engram lab fleet-day`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options

if TYPE_CHECKING:
    from engram_lab.fleet_day import DayReport


def fleet_day(
    *,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Where centre, robots and logs go.")
    ] = Path("centre-demo"),
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes that render.")] = 2,
    serve: Annotated[
        bool, typer.Option("--serve", help="Leave the centre's pages open afterwards.")
    ] = False,
    as_json: options.Json = False,
) -> None:
    """Let three robots share a map through a centre.

    Each drives, hands in over a link that breaks every 200 kB, downloads what its next mission
    needs, and drives again.

    \b
    Examples:
      engram lab fleet-day
      engram lab fleet-day --out /tmp/day --serve
    """
    from engram.cli.progress import Bars
    from engram_lab.fleet_day import run_day

    report = run_day(out, Bars(), workers)
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        _show(report)
    if serve:
        from engram.centre.service import Centre
        from engram.centre.serving import Listening
        from engram.centre.serving import serve as run

        listening = Listening("127.0.0.1", 8440)
        typer.echo(f"http://127.0.0.1:8440 with the token {report.token}; Ctrl-C ends it")
        with Centre(out / "centre") as centre:
            run(centre, listening)


def _show(report: DayReport) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("robot", "download", title="Second foray: own map against the fleet's")
    for column in (
        "localised: own",
        "fleet's",
        "new nodes: own",
        "fleet's",
        "sent, kB",
        "received",
    ):
        table.add_column(column, justify="right")
    for one in report.forays:
        table.add_row(
            one.robot,
            one.download,
            f"{one.alone:.0%}",
            f"{one.shared:.0%}",
            str(one.nodes_alone),
            str(one.nodes_shared),
            f"{one.sent_bytes / 1e3:.0f}",
            f"{one.received_bytes / 1e3:.0f}",
        )
    console = Console()
    console.print(table)
    console.print(
        f"{report.nodes} nodes in {report.revisions} revisions; {report.passed_bytes / 1e6:.1f} MB "
        f"passed the link, which broke {report.cuts} times; {report.faults} faults in any map"
    )
