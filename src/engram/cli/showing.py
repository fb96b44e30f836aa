"""`engram settings` and `engram features`: what can be set, and the kinds of features."""

from __future__ import annotations

from enum import StrEnum
from functools import partial
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
    every: Annotated[
        bool, typer.Option("--all", help="Include expert settings, which may change.")
    ] = False,
    toml: Annotated[bool, typer.Option("--toml", help="Print a file that --config reads.")] = False,
    as_json: options.Json = False,
) -> None:
    """Show the settings: value, bounds, meaning.

    Verbs with --config or --set take these settings. The resolved settings are stored with each
    revision of a map. Without --all, the public ones and those that you change are shown; --json
    has all.

    \b
    Examples:
      engram settings show
      engram settings show --all
      engram settings show --toml > engram.toml
      engram settings show --set mapper.save_every_m=2 --json
    """
    from engram.cli.settings import listed_settings, settings_toml
    from engram.config import plain

    del action  # there is one
    resolved = given.read()
    text = settings_toml if toml else listed_settings
    options.show(plain(resolved), partial(text, resolved, every=every), as_json=as_json)


class FeaturesAction(StrEnum):
    """What to do with the kinds."""

    LIST = "list"
    CHECK = "check"


def features(
    action: Annotated[
        FeaturesAction, typer.Argument(metavar="ACTION", help="list or check.")
    ] = FeaturesAction.LIST,
    kinds: Annotated[
        list[str] | None, typer.Argument(metavar="KIND", help="Kinds of features [default: all].")
    ] = None,
    *,
    as_json: options.Json = False,
) -> None:
    """List the kinds of features, or check them.

    Every map and frame log uses one kind, and only the same kind matches; a learned kind also names
    its model. Installed packages may add kinds; `check` tests whether a kind does what every kind
    must.

    \b
    Examples:
      engram features list
      engram features check net
    """
    from engram.frontend.features import feature_kind, known_kinds
    from engram.testing.contracts import check_kind

    asked = [feature_kind(name) for name in kinds] if kinds else known_kinds()
    if action is FeaturesAction.LIST:
        listed = [
            {"kind": one.name, "bits": 8 * one.descriptor_bytes, "good_at": one.good_at}
            for one in asked
        ]
        lines = [
            f"{row['kind']:14} {row['bits']} bits  {row['good_at']}".rstrip() for row in listed
        ]
        lines.append(
            "a map keeps the kind it is made with: engram map NEW.engram DRIVE --features KIND"
        )
        options.show({"kinds": listed}, "\n".join(lines), as_json=as_json)
        return
    found = {one.name: check_kind(one) for one in asked}
    rows = {name: [[c.demand, c.met, c.found] for c in part] for name, part in found.items()}
    lines = [
        f"{name:14} {'ok    ' if one.met else 'FAILED'} {one.demand}: {one.found}"
        for name, part in found.items()
        for one in part
    ]
    options.show({"checks": rows}, "\n".join(lines), as_json=as_json)
    if not all(one.met for part in found.values() for one in part):
        raise typer.Exit(1)
