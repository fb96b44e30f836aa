"""`engram view`: a map, and a drive through it, in the Rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options, outputs
from engram.cli.endings import untrusted_if


def view(
    map_path: options.MapPath,
    path: Annotated[
        Path | None, typer.Argument(metavar="DRIVE", help="A drive to localise in the map.")
    ] = None,
    *,
    view: outputs.Viewed = Path("window"),
    at: options.At = None,
    drive: options.Drive,
    settings: options.SettingsGiven,
) -> None:
    """Look at a map, and at a drive in it.

    Shows the map from above, coloured by experience. With a drive, or a file of the flight
    recorder, it also shows the images with their inliers, the nodes that were tried, and the
    robot's position and uncertainty. Needs the extra `view`.

    \b
    Examples:
      engram view town.engram
      engram view town.engram drives/tuesday
      engram view town.engram drives/tuesday --view tuesday.rrd
    """
    from engram.cli.progress import Bars
    from engram.robot import open_map, robot_on
    from engram.viewing.viewer import WINDOW, viewer_on

    with open_map(map_path, at) as opened, viewer_on(view) as viewer:
        if path is None:
            viewer.show(opened)
        else:
            sequence, given = drive.open(path), settings.read()
            asked = options.driving_of(given)
            with (
                robot_on(opened, sequence, given.of_robot(), asked) as robot,
                Bars().stage("view", len(sequence)) as monitor,
            ):
                viewer.watch(robot, opened)
                for _ in robot.drive(sequence, monitor):
                    pass
        unfit = () if path is None else robot.unfit
    if view != WINDOW:
        typer.echo(f"wrote {view}; open it with: rerun {view}")
    untrusted_if(unfit)
