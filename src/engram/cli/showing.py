"""`engram settings`: what can be set, and to what it is set."""

from __future__ import annotations

import json
from enum import StrEnum
from typing import Annotated

import typer

from engram.cli import options


class SettingsAction(StrEnum):
    """What to do with settings."""

    SHOW = "show"


def settings(
    action: Annotated[
        SettingsAction, typer.Argument(metavar="ACTION", help="show.")
    ] = SettingsAction.SHOW,
    *,
    given: options.SettingsGiven,
    toml: Annotated[bool, typer.Option("--toml", help="Print a file that --config reads.")] = False,
    as_json: options.Json = False,
) -> None:
    """Show every setting: value, bounds, meaning.

    Verbs with --config or --set take these settings. The resolved settings are stored with each
    revision of a map.

    \b
    Examples:
      engram settings show
      engram settings show --toml > engram.toml
      engram settings show --set mapper.save_every_m=2 --json
    """
    from engram.cli.settings import every_setting, settings_toml
    from engram.config import plain

    del action  # there is one
    resolved = given.read()
    if as_json:
        print(json.dumps(plain(resolved)))
        return
    if toml:
        typer.echo(settings_toml(resolved))
        return
    for one in every_setting(resolved):
        words = one.comment
        typer.echo(f"{one.key} = {json.dumps(one.value)}" + (f"  # {words}" if words else ""))
