"""`engram centre map`, `dream` and `jobs`: how its maps take hand-ins, and its jobs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from engram.cli import options
from engram.cli.centre_options import BY, NONE, Database, Folder, MapName, open_centre
from engram.errors import ConfigError


def map_(
    folder: Folder,
    name: Annotated[str, typer.Argument(metavar="NAME", help="A new or existing map.")],
    *,
    gate: Annotated[
        list[Path] | None,
        typer.Option(
            "--gate",
            metavar="DRIVE",
            help="Held-out drive that must not localise worse; repeatable; none for no gate.",
        ),
    ] = None,
    moves: Annotated[
        str | None,
        typer.Option(
            "--moves",
            metavar="REF",
            help="Version that is moved to each merge that passed the gate; none for none.",
        ),
    ] = None,
    quiet: Annotated[
        str | None,
        typer.Option(
            "--quiet",
            metavar="FROM-TO",
            help="Hours UTC in which the centre dreams, as 22-5; or none.",
        ),
    ] = None,
    settings: options.SettingsGiven,
    database: Database = None,
) -> None:
    """Make a map, or change how its hand-ins are merged.

    Options that are left out keep their values; --set and --config replace all settings of merging.

    \b
    Examples:
      engram centre map town campus --gate held-out.framelog --moves stable
      engram centre map town fleet --set merge.rounds=8
    """
    from engram.centre.service import Centre
    from engram.cli.fleet import merging_of

    changes: dict[str, Any] = {}
    if settings.config is not None or settings.changes:
        changes["merge"] = merging_of(settings.read())
    if gate:
        changes["gate"] = _gate(gate)
    if moves is not None:
        changes["moves"] = _movable(moves)
    if quiet is not None:
        changes["quiet"] = _hours(quiet)
    with Centre(folder, database) as centre:
        centre.add_map(name, BY)
        policy = replace(centre.policy(name), **changes)
        centre.set_policy(name, policy, BY)
    typer.echo(
        f"{name}: gate {', '.join(policy.gate) or NONE}, moves {policy.moves or NONE}, "
        f"quiet {NONE if policy.quiet is None else '{:g}-{:g}'.format(*policy.quiet)}"
    )


def _gate(drives: list[Path]) -> tuple[str, ...]:
    """Held-out drives, each of which opens: with one that does not, every hand-in would fail."""
    from engram.robot import open_drive

    if drives == [Path(NONE)]:
        return ()
    for one in drives:
        open_drive(one)
    return tuple(str(one.absolute()) for one in drives)


def _movable(ref: str) -> str | None:
    from engram.centre.refs import check_movable

    if ref == NONE:
        return None
    check_movable(ref)
    return ref


def _hours(text: str) -> tuple[float, float] | None:
    """The quiet hours, as FROM-TO."""
    if text == NONE:
        return None
    begin, _, end = text.partition("-")
    try:
        found = float(begin), float(end)
    except ValueError:
        found = (-1.0, -1.0)
    if not all(0.0 <= one <= 24.0 for one in found):
        raise ConfigError(f"--quiet {text!r:.40} is not FROM-TO in hours of the day, such as 22-5")
    return found


def dream(
    folder: Folder,
    *,
    map_name: MapName = "fleet",
    cancel: Annotated[
        str | None, typer.Option("--cancel", metavar="DREAM", help="End this one.")
    ] = None,
    as_json: options.Json = False,
    database: Database = None,
) -> None:
    """Ask for a dream, for whenever no robot waits.

    It looks for a better map in what robots handed in, judged by the map's held-out drives. The
    same command prints the outcome.

    \b
    Examples:
      engram centre dream town
    """
    from engram.centre.dreams import Dreams

    with open_centre(folder, database) as centre:
        dreams = Dreams(centre)
        row = dreams.ask(map_name, BY) if cancel is None else dreams.cancel(dreams.get(cancel), BY)
    typer.echo(json.dumps(row) if as_json else _told(row))


def jobs(
    folder: Folder,
    *,
    map_name: MapName = "fleet",
    cancel: Annotated[
        str | None,
        typer.Option("--cancel", metavar="JOB", help="Cancel this hand-in: its id as listed."),
    ] = None,
    as_json: options.Json = False,
    database: Database = None,
) -> None:
    """List hand-ins and dreams and their state, newest last.

    \b
    Examples:
      engram centre jobs town
      engram centre jobs town --map campus --json
    """
    from engram.centre.dreams import Dreams
    from engram.centre.handins import HandIns

    with open_centre(folder, database) as centre:
        centre.map_row(map_name)
        handins = HandIns(centre)
        if cancel is not None:
            handins.cancel(handins.get(cancel), BY)
        rows = handins.listed(map_name, None, None, 2**62, 1000)
        dreamt = Dreams(centre).listed(map_name)
    if as_json:
        print(json.dumps({"jobs": rows, "dreams": dreamt}))
        return
    for row in reversed(rows):
        typer.echo(_told(row))
    for row in reversed(dreamt):
        typer.echo(f"dream {_told(row)}")


def _told(row: dict[str, Any]) -> str:
    """A job on one line."""
    fact = row["error"] or row["progress"] or ""
    revision = "" if row["revision"] is None else f" revision {row['revision']}"
    return f"{row['id']} {row['state']}{revision} {fact}".rstrip()
