"""`engram centre …`: the fleet's shared map as a service."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from engram.cli import options
from engram.cli.options import output_folder
from engram.config import bytes_of
from engram.counts import counted
from engram.errors import ConfigError, InputError

if TYPE_CHECKING:
    from engram.fleet.centre.service import Centre, MapPolicy
    from engram.fleet.centre.tables import Dream, HandIn


Folder: TypeAlias = Annotated[Path, typer.Argument(metavar="FOLDER", help="The centre's folder.")]
MapName: TypeAlias = Annotated[
    str, typer.Option("--map", metavar="NAME", help="Which of the centre's maps.")
]
# In the environment: postgresql+psycopg://… for the tables, s3://bucket/prefix for the parts.
DATABASE = "ENGRAM_DATABASE"
OBJECTS = "ENGRAM_OBJECTS"
BY = "shell"
NONE = "none"


def stores() -> tuple[str | None, str | None]:
    """Where tables and parts are: of the environment; None for files in the centre's folder."""
    return os.environ.get(DATABASE), os.environ.get(OBJECTS)


def open_centre(folder: Path) -> Centre:
    """A centre that is there.

    Raises:
        InputError: it is not there; `serve` and `map` make one, a mistyped name does not.
    """
    from engram.fleet.centre.copies import keeps_copies
    from engram.fleet.centre.service import Centre

    database, objects = stores()
    if not (folder / ("maps" if database else "centre.sqlite")).exists() and not (
        database and objects and keeps_copies(database)
    ):
        raise InputError(f"{folder}: there is no centre; start one: engram centre serve {folder}")
    return Centre(folder, database, objects)


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
    cap: Annotated[
        str | None,
        typer.Option(
            "--cap",
            metavar="SIZE",
            help="Once a day, forget the least useful nodes until 2GB is left; none for no cap.",
        ),
    ] = None,
    copies: Annotated[
        bool,
        typer.Option(
            "--copies", help="Workers keep copies of all maps, each in a folder of its own."
        ),
    ] = False,
    settings: options.SettingsGiven,
) -> None:
    """Make a map, or change how its hand-ins are merged.

    Options that are left out keep their values; --set and --config replace all settings of merging.

    \b
    Examples:
      engram centre map town campus --gate held-out.framelog --moves stable
      engram centre map town fleet --set merge.rounds=8
      engram centre map town fleet --cap 2GB
    """
    from engram.fleet.centre.service import Centre
    from engram.fleet.cli.verbs import merging_of

    given = {"gate": gate, "moves": moves, "quiet": quiet, "cap_bytes": cap}
    changes = {rule: _READ[rule](text) for rule, text in given.items() if text not in (None, [])}
    if settings.config is not None or settings.changes:
        changes["merge"] = merging_of(settings.read())
    with Centre(folder, *stores()) as centre:
        centre.add_map(name, BY)
        policy = replace(centre.policy(name), **changes)
        centre.set_policy(name, policy, BY)
        for known in centre.map_names() if copies else ():
            centre.keep_copies(known, BY)
    typer.echo(f"{name}: {_text(policy)}")


def _text(policy: MapPolicy) -> str:
    """How a map takes hand-ins, in a line."""
    quiet = NONE if policy.quiet is None else "{:g}-{:g}".format(*policy.quiet)
    cap = NONE if policy.cap_bytes is None else f"{policy.cap_bytes / 1e6:g} MB"
    gate = ", ".join(policy.gate) or NONE
    return f"gate {gate}, moves {policy.moves or NONE}, quiet {quiet}, cap {cap}"


def _gate(drives: list[Path]) -> tuple[str, ...]:
    """Held-out drives, each of which opens: with one that does not, every hand-in would fail."""
    from engram.sequences.opening import open_drive

    if drives == [Path(NONE)]:
        return ()
    for drive in drives:
        open_drive(drive)
    return tuple(str(drive.absolute()) for drive in drives)


def _movable(ref: str) -> str | None:
    from engram.fleet.centre.fleet import check_movable

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
    if not all(0.0 <= hour <= 24.0 for hour in found):
        raise ConfigError(f"--quiet {text!r:.40} is not FROM-TO in hours of the day, such as 22-5")
    return found


def _cap(text: str) -> int | None:
    """Bytes that the nodes of a map may take."""
    if text == NONE:
        return None
    if not (size := bytes_of(text)):
        raise ConfigError(f"--cap {text!r:.40} is not a size such as 2GB or 500MB")
    return size


# How the rules of a map are typed.
_READ: dict[str, Callable[[Any], Any]] = {
    "gate": _gate, "moves": _movable, "quiet": _hours, "cap_bytes": _cap,
}  # fmt: skip


def dream(
    folder: Folder,
    *,
    map_name: MapName = "fleet",
    cancel: Annotated[
        str | None, typer.Option("--cancel", metavar="DREAM", help="End this one.")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Request a dream, to run when no robot waits.

    It searches what robots handed in for a better map, judged on the map's held-out drives. The
    same command prints the outcome.

    \b
    Examples:
      engram centre dream town
    """
    from engram.fleet.centre import dreams, jobs
    from engram.fleet.centre.tables import Dream

    with open_centre(folder) as centre:
        if cancel is None:
            row = dreams.ask(centre, map_name, BY)
        else:
            row = jobs.cancel(centre, jobs.named(centre, Dream, cancel), BY)
    options.show(_plain(row), _line(row, "dream"), as_json=as_json)


def jobs(
    folder: Folder,
    *,
    map_name: MapName = "fleet",
    cancel: Annotated[
        str | None,
        typer.Option("--cancel", metavar="JOB", help="Cancel this hand-in, by its id as listed."),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """List hand-ins and dreams and their state, newest last.

    \b
    Examples:
      engram centre jobs town
      engram centre jobs town --map campus --json
    """
    from engram.fleet.centre import dreams, handins
    from engram.fleet.centre import jobs as any_job
    from engram.fleet.centre.access import names_of
    from engram.fleet.centre.tables import HandIn

    with open_centre(folder) as centre:
        centre.map_row(map_name)
        if cancel is not None:
            any_job.cancel(centre, any_job.named(centre, HandIn, cancel), BY)
        rows = handins.listed(centre, map_name, limit=1000)
        dreamt = dreams.listed(centre, map_name)
        names = names_of(centre)
    lines = [_line(row, f"hand-in of {names.get(row.robot, row.robot)}") for row in reversed(rows)]
    lines += [_line(row, "dream") for row in reversed(dreamt)]
    found = {"jobs": list(map(_plain, rows)), "dreams": list(map(_plain, dreamt))}
    options.show(found, "\n".join(lines), as_json=as_json)


def _plain(row: HandIn | Dream) -> dict[str, Any]:
    """A job for scripts, which read its report as JSON of its own."""
    from engram.fleet.centre.tables import values_of

    report = None if row.report is None else json.dumps(row.report)
    return {**values_of(row), "report": report}


def _line(row: HandIn | Dream, what: str) -> str:
    """A job on one line."""
    from engram.fleet.transfers import SHORT

    fact = row.error or row.progress or ""
    revision = "" if row.revision is None else f" in revision {row.revision}"
    return f"{row.id[:SHORT]} {what}: {row.state}{revision} {fact}".rstrip()


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
    worker: Annotated[
        bool, typer.Option("--worker/--no-worker", help="Run a worker along with the service.")
    ] = True,
) -> None:
    """Serve maps to robots and people.

    FOLDER holds everything; no other server is needed. The first start makes the map. In the
    environment, ENGRAM_DATABASE (postgresql+psycopg://…) and ENGRAM_OBJECTS (s3://bucket/prefix)
    keep tables and parts elsewhere, for all verbs of the centre.

    \b
    Examples:
      engram centre serve town
      engram centre serve town --host 0.0.0.0 --tls-certificate town.pem --tls-key town.key
    """
    from engram.fleet.centre import serving
    from engram.fleet.centre.service import Centre
    from engram.logs import logging_to_stderr

    listening = serving.Listening(host, port, certificate, key, insecure=insecure)
    with logging_to_stderr(), Centre(folder, *stores()) as centre:
        centre.add_map(map_name, BY)
        serving.serve(centre, listening, worker=worker)


def worker(
    folder: Folder,
    *,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Dream on a Dask cluster."),
    ] = None,
) -> None:
    """Merge hand-ins, make downloads and dream until stopped.

    Any number of workers may run. Each takes a map that has work and no other worker. They share
    FOLDER, unless engram centre map --copies lets each have its own.

    \b
    Examples:
      engram centre worker town
    """
    from engram.fleet.centre.serving import run_worker

    open_centre(folder).close()
    run_worker(folder, *stores(), scheduler)


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
) -> None:
    """Print a code with which one robot enrols.

    \b
    Examples:
      engram centre code town
      engram centre code town --follows stable
    """
    from engram.fleet.centre.access import new_code

    with open_centre(folder) as centre:
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
) -> None:
    """Print a token for a person.

    It signs in to the centre's pages and its HTTP interface. The role none revokes NAME's access.

    \b
    Examples:
      engram centre token town --name alice --role operator
      engram centre token town --name alice --role none
    """
    from engram.fleet.centre.access import Role, add_person, revoke_access

    roles = [str(known) for known in Role if known is not Role.ROBOT]
    if role not in {*roles, NONE}:
        raise ConfigError(f"--role {role!r} is unknown; known: {', '.join(roles)}, {NONE}")
    with open_centre(folder) as centre:
        if role == NONE:
            typer.echo(f"access of {name} is revoked: {', '.join(revoke_access(centre, name, BY))}")
        else:
            print(add_person(centre, name, map_name, Role(role)))


def sweep(folder: Folder) -> None:
    """Remove unneeded parts, and keep maps to their caps.

    Parts that no hand-in and no download refers to are marked, and deleted by the next sweep.
    Workers sweep once a day by themselves.

    \b
    Examples:
      engram centre sweep town
    """
    from engram.fleet.centre.worker import keep_to_cap
    from engram.fleet.centre.worker import sweep as run

    with open_centre(folder) as centre:
        for name in centre.map_names():
            removed = run(centre, name)
            with centre.lane(name) as is_ours:
                nodes = keep_to_cap(centre, name) if is_ours else 0
            busy = "" if is_ours else "; a worker has the map, and keeps it to its cap"
            typer.echo(f"{name}: {removed} bytes removed, {counted(nodes, 'node')} forgotten{busy}")


def backup(
    folder: Folder,
    target: Annotated[
        Path, typer.Argument(metavar="TARGET", help="A new folder.", parser=output_folder)
    ],
) -> None:
    """Copy a centre while it runs.

    Robots may then delete what the copy holds. PostgreSQL and a bucket are not copied: do that with
    their own tools first.

    \b
    Examples:
      engram centre backup town town-backup
    """
    from engram.fleet.centre.serving import back_up

    with open_centre(folder) as centre:
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
