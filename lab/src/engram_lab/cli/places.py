"""`engram relocalise` and `engram places`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options


def relocalise(
    map_path: options.MapPath,
    path: options.DrivePath,
    *,
    relocaliser: Annotated[
        str,
        typer.Option("--relocaliser", help="How to search: fabmap, bag-of-words or exhaustive."),
    ] = "fabmap",
    lanes: options.Lanes = 2,
    rounds: options.Rounds = 32,
    at: options.At = None,
    format_: options.Format = None,
    rig: options.Rig = "grey",
    channel: options.Channel = "grey",
    frames: options.Frames = None,
    skip_bad: options.SkipBad = False,
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Find each frame of a drive in a map by itself, as a robot that was just switched on.

    \b
    Examples:
      engram relocalise town.engram drives/tuesday
      engram relocalise town.engram drives/tuesday --frames 0:1000:10 --json
    """
    from engram.cli.progress import progress
    from engram.localiser import Budget
    from engram.robot import load_settings, open_drive
    from engram.robot.results import damage_warning
    from engram_lab.relocalising import relocalise_drive, summarise_cold_starts

    sequence = open_drive(
        path, format=format_, rig=rig, channel=channel, frames=frames, skip_bad=skip_bad
    )
    with progress("relocalise", len(sequence)) as advance:
        starts = relocalise_drive(
            map_path,
            sequence,
            load_settings(config),
            relocaliser=relocaliser,
            budget=Budget(lanes, lost_rounds=rounds),
            at=at,
            advance=advance,
        )
    summary = summarise_cold_starts(starts)
    if as_json:
        print(json.dumps({"summary": summary, "frames": [one.to_dict() for one in starts]}))
        return
    if summary["damaged_nodes"]:
        typer.echo(damage_warning(summary["damaged_nodes"]), err=True)
    typer.echo(
        f"{summary['found']} of {summary['frames']} frames found at once, "
        f"{summary['unknown']} not found, {summary['new_place']} new for an empty map, "
        f"{summary['unusable_frame']} unusable; {summary['attempts']} attempts"
    )


def places(
    map_path: options.MapPath,
    *,
    top: Annotated[int, typer.Option("--top", min=1, help="How many pairs to list.")] = 10,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", metavar="FILE", help="Draw how alike all places look."),
    ] = None,
    at: options.At = None,
    as_json: options.Json = False,
) -> None:
    """List the places of a map that look most alike, though they are not near each other.

    \b
    Examples:
      engram places town.engram
      engram places town.engram --top 50 --picture confusion.png
    """
    from engram.cli.progress import progress
    from engram.maps import Map
    from engram_lab.lookalikes import find_lookalikes, write_confusion_picture

    with Map.open(map_path, at=at) as store:
        count = store.node_count()
    with progress("compare", count) as advance:
        confusion = find_lookalikes(map_path, at, advance=advance)
    if picture is not None:
        write_confusion_picture(picture, confusion)
    pairs = confusion.lookalikes[:top]
    if as_json:
        listed = [
            {"node": str(one.node), "like": str(one.like), "similarity": one.similarity}
            for one in pairs
        ]
        print(json.dumps({"nodes": count, "lookalikes": listed}))
        return
    for one in pairs:
        typer.echo(f"{one.node} looks like {one.like}: {one.similarity:.2f}")
    if not pairs:
        typer.echo("no two places apart from each other look alike")
