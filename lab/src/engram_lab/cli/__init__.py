"""The laboratory's verbs, which join the program by entry points: `engram demo`, `engram lab …`."""

import typer

from engram_lab.cli.maps import places, relocalise, try_
from engram_lab.cli.studies import evaluate
from engram_lab.cli.town import bench, demo, fleet_day, simulate

lab = typer.Typer(
    name="lab",
    help="Simulated drives, the papers' experiments, measurements.",
    epilog="Start with: engram lab simulate hamlet",
    no_args_is_help=True,
)
lab.command("simulate")(simulate)
lab.command("relocalise")(relocalise)
lab.command("places")(places)
lab.command("try")(try_)
lab.command("bench")(bench)
lab.command("fleet-day")(fleet_day)
lab.add_typer(evaluate)

__all__ = ["demo", "lab"]
