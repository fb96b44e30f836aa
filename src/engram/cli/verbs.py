"""The table of verbs."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import typer

from engram.cli.benchmark import bench
from engram.cli.building import build
from engram.cli.demonstration import demo
from engram.cli.downloading import download
from engram.cli.endings import VerbInterruptedError
from engram.cli.evaluation import evaluate
from engram.cli.explanation import explain
from engram.cli.extraction import extract
from engram.cli.history import blame, diff, log, revert, show, tag
from engram.cli.inspection import check, info, seal
from engram.cli.localisation import localise
from engram.cli.mapping import map_
from engram.cli.merging import merge
from engram.cli.places import places, relocalise, vocabulary
from engram.cli.simulation import simulate

VERBS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "extract": extract,
    "map": map_,
    "localise": localise,
    "explain": explain,
    "info": info,
    "log": log,
    "show": show,
    "diff": diff,
    "tag": tag,
    "revert": revert,
    "blame": blame,
    "check": check,
    "merge": merge,
    "build": build,
    "download": download,
    "seal": seal,
    "simulate": simulate,
    "vocabulary": vocabulary,
    "relocalise": relocalise,
    "places": places,
    "bench": bench,
}

# Verbs that have verbs below them.
GROUPS: tuple[typer.Typer, ...] = (evaluate,)
# What is done is kept as it is done there.
_GOES_ON = "interrupted; what was done is kept, and the same command goes on"


def register(app: typer.Typer) -> None:
    """Gives the program its verbs."""
    for name, verb in VERBS.items():
        app.command(name)(_tells_of_interruption(verb))
    for group in GROUPS:
        for command in group.registered_commands:
            assert command.callback is not None
            command.callback = _tells_of_interruption(command.callback, _GOES_ON)
        app.add_typer(group)


def _tells_of_interruption(
    verb: Callable[..., None], told: str = "interrupted before there was anything to save"
) -> Callable[..., None]:
    """Ctrl-C where the verb itself has nothing more to save: said like any other end."""

    @functools.wraps(verb)
    def run(*arguments: Any, **options: Any) -> None:
        try:
            verb(*arguments, **options)
        except KeyboardInterrupt:
            raise VerbInterruptedError(told) from None

    return run
