"""`engram live`: a process that localises while the robot drives."""

from __future__ import annotations

import json
import signal
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from engram.cli import options
from engram.errors import ConfigError


def live(
    map_path: options.MapPath,
    *,
    play: Annotated[
        Path | None, typer.Option("--play", metavar="DRIVE", help="Play this drive as the camera.")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", help="Play in real time [default: at once]."),
    ] = None,
    socket: Annotated[
        Path | None,
        typer.Option("--socket", metavar="PATH", help="Listen for a robot's middleware here."),
    ] = None,
    once: Annotated[
        bool, typer.Option("--once", help="End when the middleware goes away.")
    ] = False,
    name: Annotated[str, typer.Option("--robot", help="Name of the robot.")] = "robot",
    maps: Annotated[
        bool, typer.Option("--map", help="Save what the robot does not recognise.")
    ] = False,
    ranking: options.Ranking = "recall",
    lanes: options.Lanes = 2,
    rounds: options.Rounds = 2,
    deadline: Annotated[
        float | None,
        typer.Option(
            "--deadline", metavar="MS", help="Start no attempt later than this after the frame."
        ),
    ] = None,
    view: options.View = None,
    settings: options.SettingsGiven,
) -> None:
    """Localise while a robot drives.

    Takes frames from a robot's middleware, such as the ROS 2 bridge, or from a drive that it
    plays, and prints what it finds as JSON, a line each: where the robot is, whether it is lost,
    and five times a second that it is alive. The newest frame counts; older ones are dropped.

    \b
    Examples:
      engram live town.engram --socket /run/engram/r1.sock --robot r1
      engram live town.engram --socket /run/engram/r1.sock --map --deadline 40
      engram live town.engram --play drives/tuesday --rate 20
    """
    from engram.live import LiveOptions, LiveProcess, Played, Served
    from engram.robot import RobotOptions, open_drive
    from engram.viewing.viewer import viewer_for

    # Who is told to end commits what it mapped, as after Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if (play is None) == (socket is None):
        raise ConfigError("give --socket PATH to serve a robot, or --play DRIVE, one of them")
    if rate is not None and (play is None or not rate > 0):
        raise ConfigError(f"--rate is {rate}: it takes --play DRIVE, and must be > 0 Hz")
    asked = RobotOptions(policy=ranking, lanes=lanes, rounds=rounds, deadline_ms=deadline)
    resolved = LiveOptions(map_path, name, maps, settings.read().of_robot(), asked)
    with ExitStack() as stack:
        viewer = stack.enter_context(viewer_for(view))
        if socket is not None:
            serving = stack.enter_context(Served(socket, once=once))
            LiveProcess(serving, resolved, watcher=viewer).run()
        elif play is not None:
            transport = Played(open_drive(play), _print, rate)
            LiveProcess(transport, resolved, watcher=viewer).run()


def _print(message: dict[str, Any]) -> None:
    print(json.dumps(message), flush=True)
