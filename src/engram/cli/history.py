"""`engram log`, `show`, `diff`, `tag`, `revert`: the history of a map."""

from __future__ import annotations

import getpass
import os
import re
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options
from engram.cli.wording import undo_text
from engram.errors import ConfigError, RevisionError

Revision = Annotated[str, typer.Argument(metavar="REV", help="A revision: 7, a tag, head, head~2.")]
Message = Annotated[
    str, typer.Option("--message", "-m", metavar="TEXT", help="The reason, for engram log.")
]
# Takes the place of the user's name, or of the robots', as the author of revisions.
AUTHOR = "ENGRAM_AUTHOR"
# What a revision is called; all else is the beginning of a node's UUID.
_A_REVISION = re.compile(r"head(~\d+)?|\d{1,7}")


def log(
    map_path: options.MapPath,
    *,
    oneline: Annotated[bool, typer.Option("--oneline", help="Print one line each.")] = False,
    at: options.At = None,
    as_json: options.Json = False,
) -> None:
    """List a map's revisions, newest first.

    \b
    Examples:
      engram log town.engram
      engram log town.engram --oneline --at 10
      engram log town.engram --json
    """
    from engram.maps.history import log_text, map_log

    revisions = map_log(map_path, at)
    lines = (log_text(revision, oneline=oneline) for revision in revisions)
    options.show(revisions, lambda: "\n".join(lines), as_json=as_json)


def show(
    map_path: options.MapPath,
    what: Annotated[
        str, typer.Argument(metavar="REV|NODE", help="A revision, or the id of a node.")
    ] = "head",
    *,
    as_json: options.Json = False,
) -> None:
    """Show a revision or a node.

    For a revision: who made it, when, with which settings, and what it changed. For a node: the
    robot, session and revision it comes from; the first characters of its id are enough.

    \b
    Examples:
      engram show town.engram
      engram show town.engram 3 --json
      engram show town.engram 5f3a91c2
    """
    from engram.maps.history import blame_node, blame_text, log_text, map_tags, show_revision

    if _is_node(what) and what not in {one["name"] for one in map_tags(map_path)}:
        found = blame_node(map_path, what)
        options.show(found, partial(blame_text, found), as_json=as_json)
        return
    try:
        shown, changed = show_revision(map_path, what)
    except RevisionError as error:
        raise RevisionError(f"{error}; or the beginning of a node's id, 0-9 and a-f") from error
    text = [log_text(shown)] if shown["number"] else []
    found = {**shown, "difference": changed.to_dict()}
    options.show(found, "\n".join([*text, changed.text()]), as_json=as_json)


def _is_node(text: str) -> bool:
    """Whether it can only be the beginning of a node's UUID, or a tag that looks like one."""
    return _A_REVISION.fullmatch(text) is None and set(text.lower()) <= set("0123456789abcdef-")


def diff(
    map_path: options.MapPath,
    before: Revision,
    after: Revision = "head",
    *,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            metavar="FILE",
            help="Draw what changed.",
            parser=options.output_picture,
        ),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Compare two revisions.

    Lists what was added and removed (nodes, sessions, edges, path entries; nodes by hour of day),
    then each stretch of a session along which nodes changed. Only the revisions between are read.

    \b
    Examples:
      engram diff town.engram 3 7
      engram diff town.engram winter head --picture changes.png
    """
    from engram.maps.map import open_map
    from engram.viewing.drawings import draw_difference

    with open_map(map_path) as town:
        found = town.diff(before, after)
    if picture is not None:
        draw_difference(map_path, found, picture)
    options.show(found, as_json=as_json)


def tag(
    map_path: options.MapPath,
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="The tag; without it all tags are listed.")
    ] = None,
    revision: Revision = "head",
    *,
    move: Annotated[bool, typer.Option("--move", help="Move an existing tag.")] = False,
    delete: Annotated[bool, typer.Option("--delete", help="Delete the tag.")] = False,
    message: Message = "",
    as_json: options.Json = False,
) -> None:
    """Name a revision.

    Wherever a revision is expected, as in --at, its tag may be given.

    \b
    Examples:
      engram tag town.engram winter 7 --message "before the snow melted"
      engram tag town.engram
      engram tag town.engram winter --delete
    """
    from engram.maps.history import map_tags, tag_dict
    from engram.maps.map import open_map

    if name is None:
        _check_only_listing({"--delete": delete, "--move": move, "--message": bool(message)})
        tags = map_tags(map_path)
        lines = [f"{one['name']:20s} revision {one['revision']}  {one['message']}" for one in tags]
        options.show(tags, "\n".join(lines), as_json=as_json)
        return
    who = user()
    with open_map(map_path) as town:
        done = tag_dict(
            town.untag(name, author=who)
            if delete
            else town.tag(name, revision, author=who, message=message, move=move)
        )
    what = "is no longer" if delete else "is"
    text = f"revision {done['revision']} {what} tagged {done['name']}"
    options.show(done, text, as_json=as_json)


def _check_only_listing(given: dict[str, bool]) -> None:
    """Refuses options that change a tag if none is named.

    Raises:
        ConfigError: an option is given that needs a name.
    """
    for flag in (flag for flag, is_given in given.items() if is_given):
        raise ConfigError(f"{flag} needs the NAME of a tag: engram tag MAP NAME {flag}")


def revert(
    map_path: options.MapPath,
    revision: Revision,
    *,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only report what would be hidden.")
    ] = False,
    message: Message = "",
    as_json: options.Json = False,
) -> None:
    """Undo a revision with a new one.

    The new revision hides what the old one added. Nothing is deleted: earlier revisions stay
    readable, and reverting the new revision restores everything.

    \b
    Examples:
      engram revert town.engram 7 --dry-run
      engram revert town.engram 7 --message "the camera was loose"
    """
    from engram.maps.map import open_map

    with open_map(map_path) as town:
        report = town.revert(revision, author=user(), message=message, dry_run=dry_run)
    end = undo_text(map_path, report.revision.number) if report.revision else "dry run"
    options.show(report, lambda: f"{report.text()}\n{end}", as_json=as_json)


def user() -> str:
    """Author of what a person does to a map: $ENGRAM_AUTHOR, or the user's name."""
    if named := os.environ.get(AUTHOR):
        return named
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a process without a name, as in some containers
        return "unknown"
