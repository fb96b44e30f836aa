"""`engram info`, `check`, `seal`: what a map holds, and whether it is sound."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from engram.cli import options


def info(
    map_path: options.MapPath, *, at: options.At = None, as_json: options.Json = False
) -> None:
    """Say what a map holds: sessions, nodes, metres, cameras, components, size.

    \b
    Examples:
      engram info town.engram
      engram info town.engram --at 3 --json
    """
    from engram.robot import describe_map

    found = describe_map(map_path, at)
    if as_json:
        print(json.dumps(found))
        return
    for key, value in found.items():
        typer.echo(f"{key.replace('_', ' '):22s} {_plain(value)}")


def check(
    map_path: options.MapPath,
    *,
    clean: Annotated[
        bool, typer.Option("--clean", help="Also remove the rows of abandoned revisions.")
    ] = False,
    as_json: options.Json = False,
) -> None:
    """Check a map: every byte against its hash, every edge and path against its nodes.

    Ends with status 1 if anything is wrong.

    \b
    Examples:
      engram check town.engram
      engram check town.engram --clean
    """
    from engram.robot import check_map

    report = check_map(map_path, clean=clean)
    if as_json:
        print(json.dumps(report))
    else:
        for problem in report["problems"]:
            typer.echo(f"{problem['table']} {problem['record']}: {problem['fact']}")
        for session in report["interrupted"]:
            typer.echo(
                f"session {session} was interrupted: map its drive again to resume it, "
                "or `engram seal` to keep what is there"
            )
        typer.echo(
            f"{len(report['problems'])} problems in {report['rows']} rows, "
            f"{report['blobs']} blobs; {report['abandoned_rows']} abandoned rows, "
            f"{report['removed_rows']} removed"
        )
    if report["problems"]:
        raise typer.Exit(1)


def seal(
    map_path: options.MapPath,
    *,
    as_json: options.Json = False,
) -> None:
    """Keep what interrupted sessions had saved, and close them.

    \b
    Examples:
      engram seal town.engram
    """
    from engram.robot import seal_map

    sealed = seal_map(map_path)
    if as_json:
        print(json.dumps({"sealed": sealed}))
        return
    for one in sealed:
        typer.echo(
            f"session {one['session']} sealed with {one['nodes']} nodes, revision {one['revision']}"
        )
    if not sealed:
        typer.echo("no session was interrupted")


def _plain(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.1f}"
    if isinstance(value, list):
        return ", ".join(str(item) for item in value) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{key} {item}" for key, item in value.items()) or "none"
    return "none" if value is None else str(value)
