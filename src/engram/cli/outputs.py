"""Where verbs write: checked as the command line is read, before any work that it would lose."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from engram.cli.options import map_file
from engram.errors import EngramError
from engram.files import check_output, check_output_folder


class OutputError(EngramError):
    """The output of a verb cannot be written to its path."""


def _refusing(check: Callable[[str], Path]) -> Callable[[str], Path]:
    """The check as the parser of an argument or option."""

    def parse(text: str) -> Path:
        try:
            return check(text)
        except EngramError as error:
            # No ValueError: Typer would make a page of usage of it.
            raise OutputError(str(error)) from error

    return parse


def _file(text: str) -> Path:
    check_output(Path(text))
    return Path(text)


def _picture(text: str) -> Path:
    from engram.viewing import check_picture

    check_picture(Path(text))
    return Path(text)


def _folder(text: str) -> Path:
    check_output_folder(Path(text))
    return Path(text)


def _map(text: str) -> Path:
    path = map_file(text)
    check_output(path)
    return path


def _fleet_map(text: str) -> Path:
    """One that is there may be only looked at (`merge --dry-run`)."""
    path = map_file(text)
    return path if path.is_file() else _map(text)


def _recording(text: str) -> Path:
    return Path(text) if text == "window" else _file(text)


output_file = _refusing(_file)
output_picture = _refusing(_picture)
output_folder = _refusing(_folder)
output_map = _refusing(_map)
output_fleet_map = _refusing(_fleet_map)
output_recording = _refusing(_recording)

WrittenMap: TypeAlias = Annotated[
    Path, typer.Argument(metavar="MAP", help="A map, NAME.engram.", parser=output_map)
]
WrittenFleetMap: TypeAlias = Annotated[
    Path,
    typer.Argument(
        metavar="FLEET",
        help="The fleet map; created if it does not exist.",
        parser=output_fleet_map,
    ),
]
_VIEW = typer.Option(
    "--view",
    metavar="window|FILE.rrd",
    help="Watch it in Rerun, or write a recording.",
    parser=output_recording,
)
View: TypeAlias = Annotated[Path | None, _VIEW]
Viewed: TypeAlias = Annotated[Path, _VIEW]
