"""`engram log`, `show`, `diff`, `tag`, `revert`, `blame`: the history of a map."""

from __future__ import annotations

import getpass
import json
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options
from engram.errors import ConfigError

Revision = Annotated[str, typer.Argument(metavar="REV", help="A revision: 7, a tag, head, head~2.")]
Author = Annotated[
    str | None, typer.Option("--author", help="Who does it [default: the user's name].")
]
Message = Annotated[str, typer.Option("--message", "-m", help="Why; `log` shows it.")]


def log(
    map_path: options.MapPath,
    *,
    oneline: Annotated[bool, typer.Option("--oneline", help="One line for each.")] = False,
    limit: Annotated[
        int | None, typer.Option("--limit", "-n", min=1, help="Only so many, the newest.")
    ] = None,
    at: options.At = None,
    as_json: options.Json = False,
) -> None:
    """List the revisions of a map, newest first: when, who, what, and their tags.

    \b
    Examples:
      engram log town.engram
      engram log town.engram --oneline --limit 10
      engram log town.engram --json
    """
    from engram.maps.history import log_text, map_log

    revisions = map_log(map_path, at)[:limit]
    if as_json:
        print(json.dumps(revisions))
        return
    for revision in revisions:
        typer.echo(log_text(revision, oneline=oneline))


def show(
    map_path: options.MapPath, revision: Revision = "head", *, as_json: options.Json = False
) -> None:
    """Show one revision: who, when, with which settings, and what it changed.

    \b
    Examples:
      engram show town.engram
      engram show town.engram 3 --json
    """
    from engram.maps.history import log_text, show_revision

    shown, changed = show_revision(map_path, revision)
    if as_json:
        print(json.dumps({**shown, "difference": changed.to_dict()}))
        return
    if shown["number"]:
        typer.echo(log_text(shown))
    typer.echo(f"content hash {shown['content_hash']}")
    typer.echo(changed.text())


def diff(
    map_path: options.MapPath,
    before: Revision,
    after: Revision = "head",
    *,
    stretch: Annotated[
        float, typer.Option("--stretch", metavar="M", help="List changes by stretches so long.")
    ] = 50.0,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE", help="Draw what changed.")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Compare two revisions: nodes, sessions, metres, hours of day, stretch by stretch.

    A stretch is so many metres of the oldest session of each component of the map.

    \b
    Examples:
      engram diff town.engram 3 7
      engram diff town.engram winter head --picture changes.png
    """
    from engram.maps.history import diff_revisions
    from engram.viewing.difference import draw_difference

    found = diff_revisions(map_path, before, after, stretch_m=stretch)
    if picture is not None:
        draw_difference(found, picture)
    typer.echo(json.dumps(found.to_dict()) if as_json else found.text())


def tag(
    map_path: options.MapPath,
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="The tag; without one, list all.")
    ] = None,
    revision: Revision = "head",
    *,
    move: Annotated[bool, typer.Option("--move", help="Take the name from another.")] = False,
    delete: Annotated[bool, typer.Option("--delete", help="Take the name away.")] = False,
    message: Message = "",
    author: Author = None,
    as_json: options.Json = False,
) -> None:
    """Give a revision a name, by which every `--at` finds it.

    \b
    Examples:
      engram tag town.engram winter 7 --message "before the snow melted"
      engram tag town.engram
      engram tag town.engram winter --delete
    """
    from engram.maps.history import delete_tag, map_tags, tag_dict, tag_revision

    if name is None:
        _check_only_listing({"--delete": delete, "--move": move, "--message": bool(message)})
        tags = map_tags(map_path)
        if as_json:
            print(json.dumps(tags))
            return
        for one in tags:
            typer.echo(f"{one['name']:20s} revision {one['revision']}  {one['message']}")
        return
    who = author or _user()
    if delete:
        done = tag_dict(delete_tag(map_path, name, author=who))
    else:
        done = tag_dict(
            tag_revision(map_path, name, revision, author=who, message=message, move=move)
        )
    if as_json:
        print(json.dumps(done))
    else:
        what = "is no longer" if delete else "is"
        typer.echo(f"revision {done['revision']} {what} tagged {done['name']}")


def _check_only_listing(given: dict[str, bool]) -> None:
    """Without a name tags are listed: what would change one is not passed over in silence.

    Raises:
        ConfigError: an option is given that needs a name.
    """
    for flag in (flag for flag, is_given in given.items() if is_given):
        raise ConfigError(f"{flag} needs the NAME of a tag: engram tag MAP NAME {flag}")


def revert(
    map_path: options.MapPath,
    revision: Revision,
    *,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would go.")] = False,
    message: Message = "",
    author: Author = None,
    as_json: options.Json = False,
) -> None:
    """Take a revision back, by a new one that hides what it brought.

    Nothing is deleted: older revisions read as before, and reverting the new revision brings all
    of it back.

    \b
    Examples:
      engram revert town.engram 7 --dry-run
      engram revert town.engram 7 --message "the camera was loose"
    """
    from engram.maps.history import revert_revision

    report = revert_revision(
        map_path, revision, author=author or _user(), message=message, dry_run=dry_run
    )
    typer.echo(json.dumps(report.to_dict()) if as_json else report.text())


def blame(
    map_path: options.MapPath,
    nodes: Annotated[
        list[str], typer.Argument(metavar="NODE...", help="UUIDs of nodes, or their beginnings.")
    ],
    *,
    at: options.At = None,
    as_json: options.Json = False,
) -> None:
    """Say which robot, session and revision a node comes from.

    \b
    Examples:
      engram blame town.engram 5f3a
      engram blame town.engram 5f3a91c2 --json
    """
    from engram.maps.history import blame_node, blame_text

    found = [blame_node(map_path, node, at) for node in nodes]
    if as_json:
        print(json.dumps(found))
        return
    for one in found:
        typer.echo(blame_text(one))


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a process without a name, as in some containers
        return "unknown"
