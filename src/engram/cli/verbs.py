"""The table of verbs."""

from __future__ import annotations

import functools
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any

import typer

from engram.cli.building import build
from engram.cli.downloading import download
from engram.cli.endings import VerbInterruptedError
from engram.cli.explanation import explain
from engram.cli.extraction import extract
from engram.cli.history import blame, diff, log, revert, show, tag
from engram.cli.inspection import check, info, seal
from engram.cli.localisation import localise
from engram.cli.mapping import map_
from engram.cli.merging import merge
from engram.cli.vocabulary import vocabulary

VERBS: dict[str, Callable[..., None]] = {
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
    "vocabulary": vocabulary,
}

# Where installed packages name verbs of their own: functions, or Typer groups of them.
ENTRY_POINTS = "engram.verbs"
# What is done is kept as it is done there.
_GOES_ON = "interrupted; what was done is kept, and the same command goes on"


def register(app: typer.Typer) -> None:
    """Gives the program its verbs, and those that other installed packages bring."""
    for name, verb in VERBS.items():
        app.command(name)(_tells_of_interruption(verb))
    for entry in sorted(entry_points(group=ENTRY_POINTS)):
        brought = entry.load()
        if not isinstance(brought, typer.Typer):
            app.command(entry.name)(_tells_of_interruption(brought))
            continue
        _all_tell_of_interruption(brought)
        app.add_typer(brought, name=entry.name)


def _all_tell_of_interruption(group: typer.Typer) -> None:
    """The same for every verb of a group, and of the groups in it."""
    for command in group.registered_commands:
        assert command.callback is not None
        command.callback = _tells_of_interruption(command.callback, _GOES_ON)
    for inner in group.registered_groups:
        assert inner.typer_instance is not None
        _all_tell_of_interruption(inner.typer_instance)


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
