"""`engram centre …`: the fleet's shared map as a service."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from engram.cli.centre_maps import dream, jobs, map_
from engram.cli.centre_options import BY, NONE, Database, Folder, MapName, Objects, open_centre
from engram.cli.outputs import output_folder
from engram.errors import ConfigError


def serve(
    folder: Folder,
    *,
    host: Annotated[
        str, typer.Option("--host", metavar="HOST", help="Address to listen at.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", metavar="N", min=0, max=65535, help="Port to listen at.")
    ] = 8440,
    map_name: MapName = "fleet",
    certificate: Annotated[
        Path | None, typer.Option("--tls-certificate", metavar="FILE", help="TLS certificate, PEM.")
    ] = None,
    key: Annotated[
        Path | None, typer.Option("--tls-key", metavar="FILE", help="Its private key, PEM.")
    ] = None,
    insecure: Annotated[
        bool,
        typer.Option("--insecure", help="Listen on other addresses than 127.0.0.1 without TLS."),
    ] = False,
    database: Database = None,
    objects: Objects = None,
    worker: Annotated[
        bool, typer.Option("--worker/--no-worker", help="Run a worker along with the service.")
    ] = True,
) -> None:
    """Serve maps to robots and people.

    FOLDER holds everything; no other server is needed. The first start makes the map.

    \b
    Examples:
      engram centre serve town
      engram centre serve town --host 0.0.0.0 --tls-certificate town.pem --tls-key town.key
    """
    from engram.centre import serving
    from engram.centre.service import Centre
    from engram.logs import logging_to_stderr

    listening = serving.Listening(host, port, certificate, key, insecure=insecure)
    with logging_to_stderr(), Centre(folder, database, objects) as centre:
        centre.add_map(map_name, BY)
        serving.serve(centre, listening, worker=worker)


def worker(
    folder: Folder,
    *,
    database: Database = None,
    objects: Objects = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Dream on a Dask cluster."),
    ] = None,
) -> None:
    """Merge hand-ins, make downloads and dream until stopped.

    Any number of workers may run. Each takes a map that has work and no other worker.

    \b
    Examples:
      engram centre worker town
    """
    from engram.centre.serving import run_worker

    open_centre(folder, database, objects).close()
    run_worker(folder, database, objects, scheduler)


def code(
    folder: Folder,
    *,
    map_name: MapName = "fleet",
    follows: Annotated[
        str,
        typer.Option(
            "--follows", metavar="REF", help="Which version the robot follows: head or a name."
        ),
    ] = "head",
    database: Database = None,
) -> None:
    """Print a code with which one robot enrols.

    \b
    Examples:
      engram centre code town
      engram centre code town --follows stable
    """
    from engram.centre.access.enrolment import new_code

    with open_centre(folder, database) as centre:
        print(new_code(centre, map_name, follows, BY))


def token(
    folder: Folder,
    *,
    name: Annotated[str, typer.Option("--name", metavar="NAME", help="Name of the person.")],
    role: Annotated[
        str, typer.Option("--role", metavar="ROLE", help="viewer, operator, admin or none.")
    ] = "viewer",
    map_name: Annotated[
        str, typer.Option("--map", metavar="NAME", help="Which map; * for all.")
    ] = "*",
    database: Database = None,
) -> None:
    """Print a token for a person.

    It signs in to the centre's pages and its HTTP interface. The role none revokes NAME's access.

    \b
    Examples:
      engram centre token town --name alice --role operator
      engram centre token town --name alice --role none
    """
    from engram.centre.access.enrolment import add_person, take_away
    from engram.centre.access.roles import Role

    roles = [str(one) for one in Role if one is not Role.ROBOT]
    if role not in {*roles, NONE}:
        raise ConfigError(f"--role {role!r} is unknown; known: {', '.join(roles)}, {NONE}")
    with open_centre(folder, database) as centre:
        if role == NONE:
            typer.echo(f"access of {name} is revoked: {', '.join(take_away(centre, name, BY))}")
        else:
            print(add_person(centre, name, map_name, Role(role)))


def sweep(folder: Folder, *, database: Database = None, objects: Objects = None) -> None:
    """Remove parts that nothing needs any more.

    Parts that no hand-in and no download refers to are marked, and deleted by the next sweep.
    Workers sweep once a day by themselves.

    \b
    Examples:
      engram centre sweep town
    """
    from engram.centre.worker.sweeping import sweep as run

    with open_centre(folder, database, objects) as centre:
        for name in centre.map_names():
            typer.echo(f"{name}: {run(centre, name)} bytes removed")


def backup(
    folder: Folder,
    target: Annotated[
        Path, typer.Argument(metavar="TARGET", help="A new folder.", parser=output_folder)
    ],
    *,
    database: Database = None,
    objects: Objects = None,
) -> None:
    """Copy a centre while it runs.

    Robots may then delete what the copy holds. PostgreSQL and a bucket are not copied: do that with
    their own tools first.

    \b
    Examples:
      engram centre backup town town-backup
    """
    from engram.centre.backup import back_up

    with open_centre(folder, database, objects) as centre:
        for name, revision in back_up(centre, target).items():
            typer.echo(f"{name}: revision {revision} copied")


centre_group = typer.Typer(
    help="The fleet's shared map as a service.",
    epilog="Start with: engram centre serve FOLDER",
    no_args_is_help=True,
    rich_markup_mode=None,
)
_VERBS: dict[str, Callable[..., None]] = {
    "serve": serve,
    "worker": worker,
    "code": code,
    "token": token,
    "map": map_,
    "dream": dream,
    "jobs": jobs,
    "sweep": sweep,
    "backup": backup,
}
for _name, _verb in _VERBS.items():
    centre_group.command(_name)(_verb)
