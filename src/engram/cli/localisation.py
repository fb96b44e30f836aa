"""`engram localise`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from engram.cli import options

if TYPE_CHECKING:
    from engram.localiser import Localisation


def localise(
    map_path: options.MapPath,
    path: options.DrivePath,
    *,
    policy: options.Policy = "recall",
    lanes: options.Lanes = 2,
    rounds: options.Rounds = 2,
    deadline: options.Deadline = None,
    relocaliser: Annotated[
        str,
        typer.Option(
            "--relocaliser",
            help="How a lost robot is found: fabmap, bag-of-words, exhaustive or none.",
        ),
    ] = "fabmap",
    at: options.At = None,
    trajectory: Annotated[
        Path | None,
        typer.Option("--trajectory", metavar="FILE", help="Write the trajectory in TUM format."),
    ] = None,
    pictures: Annotated[
        Path | None,
        typer.Option("--pictures", metavar="DIR", help="Write matches as pictures, see --every."),
    ] = None,
    every: Annotated[
        int, typer.Option("--every", min=1, help="Frames from one picture to the next.")
    ] = 10,
    rate: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", help="Replay in real time and count late frames."),
    ] = None,
    format_: options.Format = None,
    rig: options.Rig = "grey",
    channel: options.Channel = "grey",
    frames: options.Frames = None,
    skip_bad: options.SkipBad = False,
    robot: options.Robot = None,
    start: options.Start = None,
    longitude: options.Longitude = None,
    zone: options.Zone = None,
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Localise a drive in a map, which stays as it is.

    \b
    Examples:
      engram localise town.engram drives/tuesday
      engram localise town.engram drives/tuesday --policy distance --lanes 1 --rounds 2 --json
      engram localise town.engram drives/tuesday --rate 20 --deadline 40
      engram localise town.engram drives/tuesday --trajectory tuesday.tum --pictures pictures
    """
    from engram.cli.progress import Bars
    from engram.robot import RobotOptions, load_settings, open_drive, open_map, robot_on, summarise
    from engram.viewing.pictures import PictureWriter
    from engram.viewing.trajectory import write_trajectory

    sequence = open_drive(
        path,
        format=format_,
        rig=rig,
        channel=channel,
        frames=frames,
        skip_bad=skip_bad,
        robot=robot,
        start=start,
        longitude_deg=longitude,
        zone=zone,
    )
    asked = RobotOptions(
        policy=policy,
        lanes=lanes,
        rounds=rounds,
        deadline_ms=deadline,
        relocaliser=None if relocaliser == "none" else relocaliser,
    )
    results: list[Localisation] = []
    interrupted = False
    with (
        open_map(map_path, at) as opened,
        robot_on(opened, sequence, load_settings(config), asked) as driver,
    ):
        writer = PictureWriter(pictures, every, opened.frames) if pictures else None
        with Bars().stage("localise", len(sequence)) as monitor:
            try:
                for found in driver.drive(sequence, monitor, rate):
                    results.append(found)
                    if writer is not None and driver.last is not None:
                        writer.offer(driver.last, found)
            except KeyboardInterrupt:
                interrupted = True
                typer.echo("interrupted: what follows is of the frames so far", err=True)
        if trajectory is not None:
            write_trajectory(trajectory, opened.graph, results)
    summary = {
        **summarise(results),
        "skipped_pairs": sequence.skipped,
        "interrupted": interrupted,
    }
    if as_json:
        print(json.dumps({"summary": summary, "frames": [r.to_dict() for r in results]}))
    else:
        _print(summary)
    if interrupted:
        raise typer.Exit(130)


def _print(summary: dict[str, Any]) -> None:
    from engram.robot.results import damage_warning

    if summary["damaged_nodes"]:
        typer.echo(damage_warning(summary["damaged_nodes"]), err=True)
    typer.echo(
        f"{summary['frames']} frames over {summary['driven_m']:.1f} m: "
        f"{summary['share_localised']:.1%} localised, "
        f"{summary['attempts_per_frame']:.2f} attempts per frame"
    )
    typer.echo(
        f"P(no match within 10 m) {summary['p_no_match_10m']:.2%}, "
        f"route not localised {summary['route_not_localised']:.2%}, "
        f"longest gap {summary['longest_gap_m']:.1f} m, "
        f"{summary['late_frames']} frames late, {summary['skipped_pairs']} pairs skipped"
    )
    for stage, ms in summary["stages_ms"].items():
        typer.echo(f"  {stage:14s} {ms['median']:7.2f} ms median {ms['p99']:8.2f} ms p99")
