"""The table of verbs."""

from __future__ import annotations

from collections.abc import Callable

import typer

from engram.cli.benchmark import bench
from engram.cli.demonstration import demo
from engram.cli.extraction import extract
from engram.cli.inspection import check, info, log, seal
from engram.cli.localisation import localise
from engram.cli.mapping import map_
from engram.cli.places import places, relocalise, vocabulary
from engram.cli.simulation import simulate

VERBS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "extract": extract,
    "map": map_,
    "localise": localise,
    "info": info,
    "log": log,
    "check": check,
    "seal": seal,
    "simulate": simulate,
    "vocabulary": vocabulary,
    "relocalise": relocalise,
    "places": places,
    "bench": bench,
}


def register(app: typer.Typer) -> None:
    """Gives the program its verbs."""
    for name, verb in VERBS.items():
        app.command(name)(verb)
