"""`engram doctor`: what is wrong with a drive."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options, outputs
from engram.cli.endings import ExitStatus

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from engram.calibration.cameras import Cameras
    from engram.doctor import Diagnosis
    from engram.frontend import StereoPair
    from engram.robot.front import Arrived

_PICTURES = 4


def doctor(
    path: options.DrivePath,
    *,
    drive: options.Drive,
    hours: Annotated[
        bool, typer.Option("--hours", help="Check the clock, which missions by hour need.")
    ] = False,
    pictures: Annotated[
        Path | None,
        typer.Option(
            "--pictures",
            metavar="DIR",
            help="Draw four pairs with what both sides show, and what moves with the camera.",
            parser=outputs.output_folder,
        ),
    ] = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Find out what is wrong with a drive.

    Checks up to 200 frames: whether left and right are swapped, misaligned or unsynchronised; time
    stamps, odometry, images and optics. Each finding states a value, its limit and a cure. The exit
    status is 4 if a finding is fatal; engram map refuses such a drive.

    \b
    Examples:
      engram doctor drives/monday
      engram doctor drives/monday --json --pictures looks
      engram doctor drives/monday --hours --zone Europe/London
    """
    from engram.cli.losses import losses_told
    from engram.cli.progress import Bars
    from engram.robot import examine_drive
    from engram.sequences import LoggedFrame

    sequence = dataclasses.replace(drive, skip_bad=True).open(path)
    resolved = settings.read().of_robot()
    most = min(len(sequence), resolved.doctor.frames)
    with losses_told(sequence):
        with Bars().stage("doctor", most) as monitor:
            pairs: list[StereoPair] = []

            def keep(number: int, arrived: Arrived) -> None:
                wanted = number * _PICTURES // max(most, 1) == len(pairs)
                if pictures is not None and wanted and not isinstance(arrived, LoggedFrame):
                    pairs.append(arrived)

            diagnosis = examine_drive(sequence, resolved, monitor, by_hour=hours, seen=keep)
        if pictures is not None:
            _draw(pictures, pairs)
            _draw_fixed(pictures, pairs, diagnosis, getattr(sequence, "cameras", None))
        print(json.dumps(diagnosis.to_dict()) if as_json else diagnosis.text())
        if diagnosis.fatal:
            raise typer.Exit(ExitStatus.UNFIT_DRIVE)


def _draw(folder: Path, pairs: list[StereoPair]) -> None:
    """Writes a picture of each pair."""
    from engram.viewing.sides import side_picture

    folder.mkdir(parents=True, exist_ok=True)
    for number, pair in enumerate(pairs, start=1):
        _write(folder / f"pair-{number}.png", side_picture(pair))


def _draw_fixed(
    folder: Path, pairs: list[StereoPair], diagnosis: Diagnosis, cameras: Cameras | None
) -> None:
    """Writes what moves with the camera, as a picture and as a file for --mask."""
    from engram.sequences.calibrating import mask_image
    from engram.viewing.sides import fixed_picture

    if diagnosis.seen is None or cameras is None or not pairs:
        return
    _write(folder / "fixed.png", fixed_picture(pairs[-1], diagnosis.seen))
    _write(folder / "mask.png", mask_image(diagnosis.seen, cameras))


def _write(path: Path, picture: NDArray[np.uint8]) -> None:
    import cv2

    from engram.monitor import write_whole

    with write_whole(path) as draft:
        draft.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
