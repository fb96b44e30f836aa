"""`engram map`, `localise`, `record`, `doctor`: what is done with one drive."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options
from engram.cli.options import ExitStatus, VerbInterruptedError, untrusted_if
from engram.errors import ConfigError, EngramError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from engram.calibration.calibrated_pair import Cameras
    from engram.doctor.table import Diagnosis
    from engram.frontend.frame import StereoPair
    from engram.maps.map import Map
    from engram.robot.front import Arrived
    from engram.robot.settings import Settings
    from engram.sequences.opening import Drive


@contextmanager
def losses_told(sequence: Drive) -> Iterator[None]:
    """Around what a verb does with a drive: says on stderr what of it could not be used.

    A verb that fails keeps its exit status: a loss may be the reason.

    Raises:
        Exit: parts of a bag were lost, or more frames than the doctor allows were left out for a
            wrong stamp; what could be read was used.
    """
    _noted(sequence)
    try:
        yield
    except (EngramError, VerbInterruptedError, typer.Exit):
        _told(sequence, "parts of the bag could not be read:")
        raise
    if _told(sequence, "parts of the bag could not be read; the rest was used:"):
        raise typer.Exit(ExitStatus.LOST_PARTS)


def _noted(sequence: Drive) -> None:
    """Says what of a drive's calibration was read otherwise than it is written."""
    from engram.sequences.bags.bag_sequence import BagSequence
    from engram.sequences.layouts import ImageSequence

    notes: Sequence[str] = ()
    if isinstance(sequence, BagSequence):
        notes = sequence.notes
    elif isinstance(sequence, ImageSequence):
        notes = sequence.cameras.notes
    for note in notes:
        typer.echo(f"note: {note}", err=True)


def _told(sequence: Drive, heading: str) -> bool:
    """Says how images were paired, what was lost and left out; whether it was too much."""
    from engram.doctor.examination import DoctorConfig
    from engram.sequences.bags.bag_sequence import BagSequence
    from engram.sequences.framelog.reader import FrameLog
    from engram.sequences.opening import stamps_of

    if isinstance(sequence, BagSequence) and sequence.pairing.left:
        typer.echo(sequence.pairing.text(), err=True)
    lost = sequence.lost if isinstance(sequence, BagSequence) else []
    for line in [heading, *(f"  {loss}" for loss in lost)] if lost else []:
        typer.echo(line, err=True)
    if isinstance(sequence, FrameLog):
        return False
    for fact in sequence.stamp_facts:
        typer.echo(f"warning: {fact}", err=True)
    return bool(lost) or stamps_of(sequence).faulty_share > DoctorConfig().faulty_share


def map_(
    map_path: options.WrittenMap,
    path: options.DrivePath,
    *,
    drive: options.Drive,
    features: options.Features = None,
    effort: options.Effort,
    force: Annotated[
        bool, typer.Option("--force", help="Map the drive even if the doctor finds it unfit.")
    ] = False,
    view: options.View = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Add a drive to a map.

    Creates the map if it does not exist. Where the drive matches the map well, nothing is saved;
    elsewhere it becomes a new experience. The same command resumes an interrupted drive. A drive
    with a fatal fault (see engram doctor) is refused with exit status 4; nothing is written.

    \b
    Examples:
      engram map town.engram drives/monday
      engram map town.engram drives/tuesday --robot r2 --zone Europe/London
      engram map town.engram drives/tuesday --recorded-at 2026-03-01T09:30:00Z
      engram map town.engram sequences/06 --frames 0:50:2
    """
    sequence, given = drive.open(path, settings)
    from engram.cli.screen import Bars
    from engram.cli.wording import mapped_text, warnings
    from engram.robot.mapping import Beginning, map_drive
    from engram.robot.settings import RobotOptions
    from engram.viewing.viewer import viewer_for

    asked = RobotOptions(**effort.over(given), force=force)
    resolved = given.of_robot(features)
    features = features or _asked_kind(resolved)
    with losses_told(sequence):
        with viewer_for(view) as viewer, Bars().stage("map", len(sequence)) as monitor:

            def begin(begun: Beginning) -> None:
                if viewer is not None:
                    viewer.watch(begun.robot, begun.opened)

            report = map_drive(map_path, sequence, resolved, asked, monitor, begin, features)
        done = report.to_dict()
        for warning in () if as_json else warnings(done):
            typer.echo(warning, err=True)
        options.show(done, partial(mapped_text, done, map_path), as_json=as_json)
        if report.interrupted:
            raise typer.Exit(ExitStatus.INTERRUPTED)


def localise(
    map_path: options.MapPath,
    path: options.DrivePath,
    *,
    drive: options.Seen,
    effort: options.Effort,
    deadline: Annotated[
        float | None,
        typer.Option(
            "--deadline",
            metavar="MS",
            help="Start no attempt later than this after the frame.",
            hidden=True,
        ),
    ] = None,
    at: options.At = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(
            "--trajectory",
            metavar="FILE",
            help="Write the trajectory in TUM format.",
            parser=options.output_file,
        ),
    ] = None,
    pictures: Annotated[
        Path | None,
        typer.Option(
            "--pictures",
            metavar="DIR",
            help="Write about 20 pictures of matches.",
            parser=options.output_folder,
        ),
    ] = None,
    report: options.Reported = None,
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate",
            metavar="HZ",
            help="Replay in real time and count late frames.",
            hidden=True,
        ),
    ] = None,
    remember: Annotated[
        bool,
        typer.Option(
            "--remember", help="Keep the drive's path and attempts in the map.", hidden=True
        ),
    ] = False,
    recorder: Annotated[
        Path | None,
        typer.Option(
            "--recorder",
            metavar="DIR",
            help="When lost, write the last 30 s to a file.",
            hidden=True,
            parser=options.output_folder,
        ),
    ] = None,
    no_images: Annotated[
        bool, typer.Option("--no-images", help="Record no images.", hidden=True)
    ] = False,
    view: options.RareView = None,
    explain: Annotated[
        int | None,
        typer.Option(
            "--explain",
            metavar="FRAME",
            min=0,
            help="Explain the candidates of this frame, from 0.",
        ),
    ] = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Find a drive in a map.

    The map is not changed, unless --remember keeps the drive's path and match attempts, which rank
    candidates for later drives. If the drive has a fatal fault (see engram doctor), do not trust
    the result; the exit status is 5. --explain localises the drive up to one frame, then lists that
    frame's candidates: why they are in this order, and which of them match.

    \b
    Examples:
      engram localise town.engram drives/tuesday
      engram localise town.engram drives/tuesday --ranking distance --json
      engram localise town.engram drives/tuesday --rate 20 --deadline 40
      engram localise town.engram drives/tuesday --trajectory tuesday.tum --pictures matches
      engram localise town.engram drives/tuesday --report tuesday.html
      engram localise town.engram drives/tuesday --explain 120
    """
    sequence, given = drive.open(path, settings)
    from engram.cli.localising import Outputs, explain_and_print, localise_and_print
    from engram.maps.map import open_map
    from engram.robot.settings import RobotOptions

    resolved = given.of_robot()
    asked = RobotOptions(**effort.over(given), deadline_ms=deadline)
    if explain is None:
        wanted = Outputs(
            map_path,
            path,
            trajectory,
            pictures,
            rate,
            as_json,
            remember,
            recorder,
            not no_images,
            view,
            report,
        )
        with losses_told(sequence), open_map(map_path, at) as opened:
            _follow(opened, resolved)
            if not opened.node_count():
                typer.echo(_empty(opened), err=True)
            localise_and_print(opened, sequence, resolved, asked, wanted)
        return
    refused = {
        "--trajectory": trajectory, "--pictures": pictures, "--rate": rate, "--deadline": deadline,
        "--remember": remember or None, "--recorder": recorder, "--view": view, "--report": report,
    }  # fmt: skip
    for option in (option for option, value in refused.items() if value is not None):
        raise ConfigError(f"--explain is about one frame; leave out {option}")
    with open_map(map_path, at) as opened:
        explain_and_print(opened, sequence, explain, resolved, asked, as_json=as_json)


def record(
    path: options.DrivePath,
    out: Annotated[
        Path,
        typer.Argument(
            metavar="LOG", help="The frame log, NAME.framelog.", parser=options.output_file
        ),
    ],
    *,
    drive: options.Drive,
    features: options.Features = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Store a drive compactly, as a frame log.

    A frame log keeps features and odometry in a sixteenth of the space of the images. Every verb
    reads it like the drive itself. The same command resumes an interrupted recording. The log of a
    drive with a fatal fault is kept, and the exit status is 5: engram map refuses its images.

    \b
    Examples:
      engram record drives/monday monday.framelog
      engram record 2011_09_26_drive_0001_sync colour.framelog --set drive.rig=colour
    """
    sequence, given = drive.open(path, settings)
    from engram.cli.screen import Bars
    from engram.robot.mapping import extract_log

    resolved = given.of_robot(features)
    with losses_told(sequence):
        with Bars().stage("record", len(sequence)) as monitor:
            most = resolved.mapper.landmarks_for(sequence.camera)
            report = extract_log(sequence, out, resolved, monitor, most)
        options.show(report, as_json=as_json)
        if report.interrupted:
            raise typer.Exit(ExitStatus.INTERRUPTED)
        if report.diagnosis is not None:
            untrusted_if(report.diagnosis.fatal)


def _asked_kind(settings: Settings) -> str | None:
    """The kind of features that the settings name; None for the default, which follows a map's."""
    from engram.frontend.frontend import FrontendConfig

    kind = settings.frontend.descriptor
    return None if kind == FrontendConfig().descriptor else kind


def _follow(opened: Map, settings: Settings) -> None:
    """Rejects settings whose features differ from the map's: nothing would match.

    Raises:
        ConfigError: they do.
    """
    asked, found = _asked_kind(settings), opened.descriptor
    if asked is not None and found is not None and asked != found:
        raise ConfigError(
            f"{opened.location} has {found} features, not {asked}; leave out frontend.descriptor, "
            f"or map the drives into another map with --features {asked.partition('@')[0]}"
        )


def _empty(opened: Map) -> str:
    """Why nothing can be found in a map without nodes."""
    begun = [str(one.session.id)[:8] for one in opened.interrupted()]
    if begun:
        return (
            f"warning: the map is empty: session {begun[0]} was interrupted; map its drive again, "
            "or commit what it saved with engram check --seal"
        )
    return "warning: the map is empty; begin it with engram map"


_PICTURES = 4


def doctor(
    path: options.DrivePath,
    *,
    drive: options.Seen,
    hours: Annotated[
        bool, typer.Option("--hours", help="Check the clock, which missions by hour need.")
    ] = False,
    pictures: Annotated[
        Path | None,
        typer.Option(
            "--pictures",
            metavar="DIR",
            help="Draw four pairs with what both sides show, and what moves with the camera.",
            parser=options.output_folder,
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
      engram doctor drives/monday --hours --set drive.zone=Europe/London
    """
    from engram.cli.screen import Bars
    from engram.robot.mapping import examine_drive
    from engram.sequences.sequence import LoggedFrame

    changes = [*(settings.changes or ()), "drive.skip_bad=true"]
    sequence, given = drive.open(path, replace(settings, changes=changes))
    resolved = given.of_robot()
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
        options.show(diagnosis, as_json=as_json)
        if diagnosis.fatal:
            raise typer.Exit(ExitStatus.UNFIT_DRIVE)


def _draw(folder: Path, pairs: list[StereoPair]) -> None:
    """Writes a picture of each pair."""
    from engram.viewing.pictures import side_picture

    folder.mkdir(parents=True, exist_ok=True)
    for number, pair in enumerate(pairs, start=1):
        _write(folder / f"pair-{number}.png", side_picture(pair))


def _draw_fixed(
    folder: Path, pairs: list[StereoPair], diagnosis: Diagnosis, cameras: Cameras | None
) -> None:
    """Writes what moves with the camera, as a picture and as a file for `drive.mask`."""
    from engram.sequences.calibrating import mask_image
    from engram.viewing.pictures import fixed_picture

    if diagnosis.seen is None or cameras is None or not pairs:
        return
    _write(folder / "fixed.png", fixed_picture(pairs[-1], diagnosis.seen))
    _write(folder / "mask.png", mask_image(diagnosis.seen, cameras))


def _write(path: Path, picture: NDArray[np.uint8]) -> None:
    import cv2

    from engram.monitor import write_whole

    with write_whole(path) as draft:
        draft.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
