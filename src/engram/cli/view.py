"""`engram view`: a map, and a drive through it, in the Rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options


def view(
    map_path: options.MapPath,
    path: Annotated[
        Path | None, typer.Argument(metavar="[DRIVE]", help="A drive to localise in it.")
    ] = None,
    *,
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="FILE.rrd", help="Write a recording; open no window."),
    ] = None,
    at: options.At = None,
    drive: options.Drive,
    settings: options.SettingsGiven,
) -> None:
    """Look at a map, and at a drive in it.

    Shows the map from above by experience. With a drive, or a file of the flight recorder: its
    images with the inliers, the nodes that were tried, where the robot is and how sure. Needs the
    extra view.

    \b
    Examples:
      engram view town.engram
      engram view town.engram drives/tuesday
      engram view town.engram drives/tuesday --save tuesday.rrd
    """
    from engram.cli.progress import Bars
    from engram.robot import open_map, robot_on
    from engram.viewing.viewer import Viewer

    with open_map(map_path, at) as opened, Viewer(save) as viewer:
        if path is None:
            viewer.show(opened)
        else:
            sequence = drive.open(path)
            with (
                robot_on(opened, sequence, settings.read().of_robot()) as robot,
                Bars().stage("view", len(sequence)) as monitor,
            ):
                viewer.watch(robot, opened)
                for _ in robot.drive(sequence, monitor):
                    pass
    if save is not None:
        typer.echo(f"{save} is written; look at it with rerun {save}")
