"""`engram live`: a process that localises while the robot drives."""

from __future__ import annotations

import json
import signal
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from engram.cli import options, outputs
from engram.cli.endings import VerbInterruptedError, untrusted_if
from engram.errors import ConfigError


def live(
    map_path: options.MapPath,
    *,
    play: Annotated[
        Path | None, typer.Option("--play", metavar="DRIVE", help="Play this drive as the camera.")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate", metavar="HZ", help="Play at this rate [default: as fast as it goes]."
        ),
    ] = None,
    socket: Annotated[
        Path | None,
        typer.Option(
            "--socket", metavar="PATH", help="Listen for a robot's middleware at this socket."
        ),
    ] = None,
    once: Annotated[
        bool, typer.Option("--once", help="End when the middleware disconnects.")
    ] = False,
    name: Annotated[
        str, typer.Option("--robot", metavar="NAME", help="Name of the robot.")
    ] = "robot",
    maps: Annotated[
        bool, typer.Option("--map", help="Map what the robot does not recognise.")
    ] = False,
    effort: options.Effort,
    deadline: Annotated[
        float | None,
        typer.Option(
            "--deadline", metavar="MS", help="Start no attempt later than this after the frame."
        ),
    ] = None,
    view: outputs.View = None,
    settings: options.SettingsGiven,
) -> None:
    """Localise while a robot drives.

    Takes frames from a robot's middleware, such as the ROS 2 bridge, or plays a drive. Prints one
    line of JSON for each result (where the robot is, or that it is lost) and a status five times a
    second. The newest frame is used; older ones are dropped.

    \b
    Examples:
      engram live town.engram --socket /run/engram/r1.sock --robot r1
      engram live town.engram --socket /run/engram/r1.sock --map --deadline 40
      engram live town.engram --play drives/tuesday --rate 20
    """
    from engram.live import LiveOptions, LiveProcess, Played, Served, Transport
    from engram.robot import RobotOptions, open_drive
    from engram.viewing.viewer import viewer_for

    # A process that is asked to end commits what it mapped, as after Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if (play is None) == (socket is None):
        raise ConfigError("give either --socket PATH, to serve a robot, or --play DRIVE")
    if rate is not None and (play is None or not rate > 0):
        raise ConfigError(f"--rate {rate}: must be > 0 Hz, and goes with --play DRIVE only")
    given = settings.read()
    asked = RobotOptions(**effort.over(given), deadline_ms=deadline)
    resolved = LiveOptions(map_path, name, maps, given.of_robot(), asked)
    with ExitStack() as stack:
        viewer = stack.enter_context(viewer_for(view))
        transport: Transport
        if play is not None:
            transport = Played(open_drive(play), _print, rate)
        else:
            assert socket is not None
            transport = stack.enter_context(Served(socket, once=once))
        process = LiveProcess(transport, resolved, watcher=viewer)
        try:
            process.run()
        except KeyboardInterrupt:
            told = f"interrupted; {process.saving.text()}"
            raise VerbInterruptedError(told) from None
    untrusted_if(process.unfit)


def _print(message: dict[str, Any]) -> None:
    print(json.dumps(message), flush=True)
