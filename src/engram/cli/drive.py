"""`engram drive …`: what a drive holds; `engram live`: a process that localises while driving."""

from __future__ import annotations

import json
import shlex
import signal
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from engram.cli import options
from engram.cli.options import VerbInterruptedError, untrusted_if
from engram.counts import counted
from engram.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from engram.calibration.calibrated_pair import Cameras
    from engram.sequences.bags.bag_sequence import BagFacts, BagSequence
    from engram.sequences.layouts import ImageSequence


drive_group = typer.Typer(
    help="Look at a drive: topics, calibration.",
    epilog="Start with: engram drive info DRIVE",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@drive_group.command("info")
def info(
    path: options.DrivePath,
    *,
    opening: options.Seen,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Show what a drive holds, and how to map it.

    For a bag this lists topics (type, rate, size, gaps), calibration and transforms, and prints the
    command that maps it.

    \b
    Examples:
      engram drive info monday.bag
      engram drive info monday/ --left /front/left/image_raw
    """
    from engram.config import plain
    from engram.sequences.bags.bag_sequence import describe_bag
    from engram.sequences.bags.containers import is_bag
    from engram.sequences.sequence import OpenOptions

    if is_bag(path):
        asked = OpenOptions.of(opening.over(settings.read()))
        facts = describe_bag(path, asked)
        more = [*opening.typed("left", "right", "calibration", "motion"), *settings.typed()]
        if facts.command and more:
            facts = replace(facts, command=f"{facts.command} {shlex.join(more)}")
        options.show(plain(facts), partial(_bag_text, facts), as_json=as_json)
        if facts.lost or facts.question:
            raise typer.Exit(3 if facts.lost else 2)
        _judge(facts.faulty_share)
        return
    found = _drive_facts(path, opening, settings)
    options.show(found, partial(_drive_text, found), as_json=as_json)
    _judge(found["faulty_share"])


def _judge(faulty_share: float) -> None:
    """Ends with the status of losses if too many frames are left out for a wrong stamp."""
    from engram.doctor.examination import DoctorConfig

    if faulty_share > DoctorConfig().faulty_share:
        raise typer.Exit(3)


@drive_group.command("calibration")
def calibration(
    path: options.DrivePath,
    *,
    opening: options.Seen,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            metavar="PNG",
            help="The picture [default: DRIVE-calibration.png].",
            parser=options.output_file,
        ),
    ] = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Show a drive's calibration, and draw a rectified pair.

    Prints TOML with a table as comments. Save it as calibration.toml, edit it and pass it with
    --calibration. The picture shows one rectified pair: the same point should lie on the same line
    in both images.

    \b
    Examples:
      engram drive calibration monday.bag > calibration.toml
      engram drive calibration monday.bag --calibration calibration.toml
    """
    import cv2

    from engram.config import plain
    from engram.errors import ConfigError
    from engram.monitor import write_whole
    from engram.sequences.framelog.reader import FrameLog
    from engram.untrusted import printable
    from engram.viewing.pictures import rectified_picture, row_offsets_px

    sequence, _ = opening.open(path, settings)
    if isinstance(sequence, FrameLog):
        raise ConfigError(f"{path}: a frame log has no images to calibrate; name its drive")
    pair = next(iter(sequence))
    offsets = row_offsets_px(pair)
    out = picture or Path(f"{sequence.info.name}-calibration.png")
    caption = f"{sequence.info.name}, {len(offsets)} matched corners{_rows_text(offsets)}"
    _, content = cv2.imencode(".png", rectified_picture(pair, printable(caption)))
    with write_whole(out) as draft:
        draft.write_bytes(content.tobytes())
    lines = _calibration_lines(sequence, offsets)
    if as_json:
        camera = {name: getattr(sequence.camera, name) for name in _CAMERA}
        typer.echo(json.dumps(plain({**camera, "picture": out, "rows_px": offsets.tolist()})))
        return
    typer.echo("\n".join(f"# {line}" for line in lines))
    typer.echo(_toml(sequence.cameras))
    typer.echo(f"one rectified pair: {out}", err=True)


_CAMERA = ("fx", "fy", "cx", "cy", "baseline_m", "width", "height")


def _calibration_lines(
    sequence: ImageSequence | BagSequence, offsets: NDArray[np.float64]
) -> list[str]:
    import numpy as np

    camera, cameras = sequence.camera, sequence.cameras
    view_deg = np.rad2deg(2 * np.arctan(camera.width / 2 / camera.fx))
    if cameras.raw is not None:
        images = f"raw, {cameras.raw.left.distortion} lenses; rectified on reading"
    else:
        images = "rectified" if cameras.rectification is None else "raw; rectified by a table"
    mounting = "unknown"
    if camera.cam_from_rig is not None:
        x, y, z = camera.cam_from_rig.inverse().translation + 0.0  # no -0.000
        mounting = f"left camera at ({x:.3f}, {y:.3f}, {z:.3f}) m in the robot's frame"
    return [
        f"drive          {sequence.info.name} ({sequence.info.format})",
        f"images         {camera.width} × {camera.height} px, {images}",
        f"rectified      fx {camera.fx:.3f}  fy {camera.fy:.3f}  cx {camera.cx:.3f}  "
        f"cy {camera.cy:.3f} px",
        f"field of view  {view_deg:.1f}° wide",
        f"baseline       {camera.baseline_m:.6f} m",
        f"mounting       {mounting}",
        f"rows           {len(offsets)} matched corners{_rows_text(offsets)}",
    ]


def _rows_text(offsets: NDArray[np.float64]) -> str:
    """How well the rows of the pair agree."""
    import numpy as np

    if not len(offsets):
        return ""
    middle = np.median(offsets)
    spread = np.median(np.abs(offsets - middle))
    return f", right image {middle:+.2f} px off in height (median; half within {spread:.2f} px)"


def _toml(cameras: Cameras) -> str:
    from engram.calibration.toml import calibration_toml
    from engram.errors import CalibrationError

    try:
        return calibration_toml(cameras)
    except CalibrationError as error:
        return f"# {error}"


def _bag_text(facts: BagFacts) -> str:
    width = max(len(topic.name) for topic in facts.topics)
    lines = [
        f"{facts.path}: {_size(facts.size_bytes)} in "
        f"{counted(facts.files, 'file')}, {facts.duration_s:.1f} s"
    ]
    for topic in facts.topics:
        gaps = (
            f"{counted(topic.gaps, 'gap')}, longest {topic.longest_gap_s:.2f} s"
            if topic.gaps
            else ""
        )
        rate = f"{topic.rate_hz:7.1f} Hz" if topic.rate_hz else " " * 10
        lines.append(
            f"  {topic.name:{width}}  {topic.messages:>7} × {topic.type:32} "
            f"{rate} {_size(topic.size_bytes):>12}  {gaps}".rstrip()
        )
    if facts.left is not None:
        lines.append(f"stereo: {facts.left}, {facts.right}")
        lines.append(f"calibration: {facts.calibration}")
        lines.append(f"mounting: {facts.mounting or 'unknown'}")
    if facts.transforms:
        lines.append(f"static transforms: {', '.join(facts.transforms)}")
    lines += [f"note: {note}" for note in facts.notes]
    if facts.question:
        lines.append(f"missing: {facts.question}")
    lines += [f"stamps: {fact}" for fact in facts.stamps]
    lines += [f"lost: {loss}" for loss in facts.lost]
    if facts.command:
        lines.append(f"next: {facts.command}")
    return "\n".join(lines)


def _size(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.1f} MB" if size_bytes >= 1e5 else f"{size_bytes / 1e3:.1f} kB"


def _drive_facts(
    path: Path, opening: options.Seen, settings: options.SettingsGiven
) -> dict[str, Any]:
    from engram.sequences.layouts import ImageSequence
    from engram.sequences.opening import stamps_of

    sequence, _ = opening.open(path, settings)
    stamps_ns = getattr(sequence, "stamps_ns", None)
    seconds = 0.0 if stamps_ns is None else float(stamps_ns[-1] - stamps_ns[0]) / 1e9
    return {
        "path": str(path),
        "format": sequence.info.format,
        "clock": str(sequence.info.clock),
        "pairs": len(sequence),
        "duration_s": seconds,
        **{name: getattr(sequence.camera, name) for name in _CAMERA},
        "notes": list(sequence.cameras.notes) if isinstance(sequence, ImageSequence) else [],
        "stamps": getattr(sequence, "stamp_facts", []),
        "faulty_share": stamps_of(sequence).faulty_share,
        "command": shlex.join(
            ["engram", "map", "MAP.engram", str(path), *opening.typed(), *settings.typed()]
        ),
    }


def _drive_text(facts: dict[str, Any]) -> str:
    return (
        f"{facts['path']}: {facts['format']}, {counted(facts['pairs'], 'pair')} in "
        f"{facts['duration_s']:.1f} s, clock {facts['clock']}\n"
        f"camera: {facts['width']}×{facts['height']} px, fx {facts['fx']:.1f} px, baseline "
        f"{facts['baseline_m']:.4f} m\n"
        + "".join(f"note: {note}\n" for note in facts["notes"])
        + "".join(f"stamps: {fact}\n" for fact in facts["stamps"])
        + f"next: {facts['command']}"
    )


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
    view: options.View = None,
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
    from engram.live.driving import LiveOptions
    from engram.live.process import LiveProcess
    from engram.live.served import Played, Served, Transport
    from engram.robot.settings import RobotOptions
    from engram.sequences.opening import open_drive
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
