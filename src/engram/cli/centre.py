"""`engram centre …`: the fleet's shared map as a service."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from engram.cli import options

if TYPE_CHECKING:
    from engram.centre.service import Centre

centre_group = typer.Typer(
    help="The fleet's shared map as a service.", no_args_is_help=True, rich_markup_mode=None
)

Folder: TypeAlias = Annotated[Path, typer.Argument(metavar="FOLDER", help="The centre's folder.")]
MapName: TypeAlias = Annotated[str, typer.Option("--map", metavar="NAME", help="A map.")]
Database: TypeAlias = Annotated[
    str | None,
    typer.Option("--database", metavar="URL", help="postgresql+psycopg://… [default: SQLite]."),
]
Objects: TypeAlias = Annotated[
    str | None,
    typer.Option("--objects", metavar="URL", help="s3://bucket/prefix [default: a folder]."),
]
_BY = "shell"


def _open(folder: Path, database: str | None = None, objects: str | None = None) -> Centre:
    from engram.centre.service import Centre

    return Centre(folder, database, objects)


@centre_group.command()
def serve(
    folder: Folder,
    *,
    host: Annotated[str, typer.Option("--host", help="Address to listen at.")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535)] = 8440,
    map_name: MapName = "fleet",
    certificate: Annotated[
        Path | None, typer.Option("--tls-certificate", metavar="FILE", help="PEM.")
    ] = None,
    key: Annotated[Path | None, typer.Option("--tls-key", metavar="FILE", help="PEM.")] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Listen elsewhere than here without TLS.")
    ] = False,
    database: Database = None,
    objects: Objects = None,
    worker: Annotated[
        bool, typer.Option("--worker/--no-worker", help="Run a worker beside the service.")
    ] = True,
) -> None:
    """Serve maps to robots and people.

    Everything is in FOLDER: no other server is needed. The first start makes the map.

    \b
    Examples:
      engram centre serve town
      engram centre serve town --host 0.0.0.0 --tls-certificate town.pem --tls-key town.key
    """
    from engram.centre.serving import Listening
    from engram.centre.serving import serve as run

    listening = Listening(host, port, certificate, key, insecure=insecure)
    with _open(folder, database, objects) as centre:
        centre.add_map(map_name, _BY)
        run(centre, listening, worker=worker)


@centre_group.command()
def worker(folder: Folder, *, database: Database = None, objects: Objects = None) -> None:
    """Merge hand-ins and make downloads until it is stopped.

    Any number of workers may run; each takes a map that has work and that no other one has.
    """
    from engram.centre.serving import run_worker

    run_worker(folder, database, objects)


@centre_group.command()
def code(
    folder: Folder,
    *,
    map_name: MapName = "fleet",
    follows: Annotated[
        str, typer.Option("--follows", metavar="REF", help="What the robot is to run.")
    ] = "head",
    database: Database = None,
) -> None:
    """Print a code with which one robot enrols."""
    from engram.centre.access.enrolment import new_code

    with _open(folder, database) as centre:
        print(new_code(centre, map_name, follows, _BY))


@centre_group.command()
def token(
    folder: Folder,
    *,
    name: Annotated[str, typer.Option("--name", help="Whose.")],
    role: Annotated[str, typer.Option("--role", help="viewer, operator or admin.")] = "viewer",
    map_name: Annotated[str, typer.Option("--map", metavar="NAME", help="* for all.")] = "*",
    database: Database = None,
) -> None:
    """Print a token for a person; it opens the pages, too."""
    from engram.centre.access.enrolment import add_person
    from engram.centre.access.roles import Role
    from engram.errors import ConfigError

    roles = [str(one) for one in Role if one is not Role.ROBOT]
    if role not in roles:
        raise ConfigError(f"--role {role!r} is unknown; known: {', '.join(roles)}")
    with _open(folder, database) as centre:
        print(add_person(centre, name, map_name, Role(role)))


@centre_group.command("map")
def map_(
    folder: Folder,
    name: Annotated[str, typer.Argument(metavar="NAME", help="A new or existing map.")],
    *,
    gate: Annotated[
        list[Path] | None,
        typer.Option("--gate", metavar="DRIVE", help="Must not localise worse; repeatable."),
    ] = None,
    moves: Annotated[
        str | None,
        typer.Option("--moves", metavar="REF", help="Follows every merge that the gate passed."),
    ] = None,
    settings: options.SettingsGiven,
    database: Database = None,
) -> None:
    """Make a map, or change how one takes hand-ins."""
    from engram.centre.service import MapPolicy
    from engram.cli.fleet import merging_of

    policy = MapPolicy(
        merging_of(settings.read()), tuple(str(one.absolute()) for one in gate or ()), moves
    )
    with _open(folder, database) as centre:
        centre.add_map(name, _BY)
        centre.set_policy(name, policy, _BY)


@centre_group.command()
def jobs(
    folder: Folder,
    *,
    map_name: MapName = "fleet",
    cancel: Annotated[
        str | None, typer.Option("--cancel", metavar="JOB", help="End this one.")
    ] = None,
    as_json: options.Json = False,
    database: Database = None,
) -> None:
    """List hand-ins, newest last, with what became of them."""
    from engram.centre.handins import HandIns

    with _open(folder, database) as centre:
        handins = HandIns(centre)
        if cancel is not None:
            handins.cancel(handins.get(cancel), _BY)
        rows = handins.listed(map_name, None, None, 2**62, 1000)
    if as_json:
        print(json.dumps({"jobs": rows}))
        return
    for row in reversed(rows):
        fact = row["error"] or row["progress"] or ""
        revision = "" if row["revision"] is None else f" revision {row['revision']}"
        typer.echo(f"{row['id']} {row['state']}{revision} {fact}".rstrip())


@centre_group.command()
def sweep(folder: Folder, *, database: Database = None, objects: Objects = None) -> None:
    """Remove parts that no hand-in and no download needs any more.

    Workers do it by themselves, once a day; the next sweep deletes what this one forgets.
    """
    from engram.centre.worker.sweeping import sweep as run

    with _open(folder, database, objects) as centre:
        for name in centre.map_names():
            typer.echo(f"{name}: {run(centre, name)} bytes")


@centre_group.command()
def backup(
    folder: Folder,
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="A new folder.")],
) -> None:
    """Copy a centre while it runs, and let robots forget what the copy holds."""
    from engram.centre.backup import back_up

    with _open(folder) as centre:
        for name, revision in back_up(centre, target).items():
            typer.echo(f"{name}: revision {revision}")
