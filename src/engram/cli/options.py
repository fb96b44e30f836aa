"""Options that several verbs share, and the sequence they describe."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer


def map_file(text: str) -> Path:
    """A map as it is typed: a file; maps in PostgreSQL have addresses, which no verb takes.

    Raises:
        BadParameter: it is an address. It may hold a password, so it is not repeated.
    """
    from engram.maps.map import is_address

    if is_address(text):
        raise typer.BadParameter(
            "this is the address of a map in PostgreSQL; the program works on map files. From "
            "Python, engram.fleet.download writes what is there to a file"
        )
    return Path(text)


MapPath: TypeAlias = Annotated[
    Path, typer.Argument(metavar="MAP", help="A map, NAME.engram.", parser=map_file)
]
DrivePath: TypeAlias = Annotated[
    Path, typer.Argument(metavar="PATH", help="A drive: a folder of stereo images or a frame log.")
]
Json: TypeAlias = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
At: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--at", metavar="REV|TAG", help="Read the map as of this revision: 7, a tag, head~2."
    ),
]
Format: TypeAlias = Annotated[
    str | None,
    typer.Option("--format", help="kitti, kitti-raw, euroc, folder or framelog [default: seen]."),
]
Rig: TypeAlias = Annotated[str, typer.Option("--rig", help="Of several rigs: grey or colour.")]
Channel: TypeAlias = Annotated[
    str, typer.Option("--channel", help="Of colour images: grey, red, green or blue.")
]
Frames: TypeAlias = Annotated[
    str | None,
    typer.Option("--frames", metavar="START:STOP:STEP", help="Only these frames, as in 0:100:2."),
]
SkipBad: TypeAlias = Annotated[
    bool, typer.Option("--skip-bad", help="Go on past images that cannot be used, and count them.")
]
Robot: TypeAlias = Annotated[
    str | None, typer.Option("--robot", help="Name of the robot [default: from the drive].")
]
Start: TypeAlias = Annotated[
    str | None,
    typer.Option("--start", metavar="TIME", help="When the drive began, ISO 8601 in UTC."),
]
Longitude: TypeAlias = Annotated[
    float | None, typer.Option("--longitude", help="Where the drive was, degrees east.")
]
Zone: TypeAlias = Annotated[
    str | None, typer.Option("--zone", help="Time zone of the drive, as in Europe/London.")
]
Settings: TypeAlias = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="Settings in TOML.")
]
Lanes: TypeAlias = Annotated[
    int, typer.Option("--lanes", min=1, help="Match attempts at the same time (Np).")
]
Rounds: TypeAlias = Annotated[
    int, typer.Option("--rounds", min=1, help="Rounds of attempts for one frame (Nr).")
]
SureInliers: TypeAlias = Annotated[
    int,
    typer.Option(
        "--sure-inliers",
        min=0,
        help="Leave out a node that other drives rely on only for a match of so many inliers; "
        "0 for every match, as in the paper.",
    ),
]
Deadline: TypeAlias = Annotated[
    float | None,
    typer.Option("--deadline", metavar="MS", help="No attempt starts later after its frame."),
]
Policy: TypeAlias = Annotated[
    str,
    typer.Option(
        "--policy",
        help="Ranking: recall, path, path-near, distance, or one that an installed package brings.",
    ),
]
Descriptor: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--descriptor", help="brief or teblid, for a new map or log [default: the map's, or brief]."
    ),
]
