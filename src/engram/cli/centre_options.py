"""What the verbs of `engram centre` share: their arguments, and a centre that is there."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from engram.errors import InputError

if TYPE_CHECKING:
    from engram.centre.service import Centre

Folder: TypeAlias = Annotated[Path, typer.Argument(metavar="FOLDER", help="The centre's folder.")]
MapName: TypeAlias = Annotated[
    str, typer.Option("--map", metavar="NAME", help="Which of the centre's maps.")
]
Database: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--database", metavar="URL", help="postgresql+psycopg://… [default: SQLite in FOLDER]."
    ),
]
Objects: TypeAlias = Annotated[
    str | None,
    typer.Option("--objects", metavar="URL", help="s3://bucket/prefix [default: files in FOLDER]."),
]
BY = "shell"
NONE = "none"


def open_centre(folder: Path, database: str | None = None, objects: str | None = None) -> Centre:
    """A centre that is there.

    Raises:
        InputError: it is not there; `serve` and `map` make one, a mistyped name does not.
    """
    from engram.centre.service import Centre

    if not (folder / ("maps" if database else "centre.sqlite")).exists():
        raise InputError(f"{folder}: there is no centre; start one: engram centre serve {folder}")
    return Centre(folder, database, objects)
