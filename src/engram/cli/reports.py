"""`engram report`: a page to look at; `engram evaluate`: a drive against its ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from engram.evaluation import Evaluation
    from engram.frontend.frame import StereoPair
    from engram.robot.front import Arrived
    from engram.robot.results import DriveSummary
    from engram.sequences.motion_files import Trajectory
    from engram.viewing.page import Page

# Pairs on the page of a drive.
_PAIRS = 3
_TRAJECTORIES = frozenset({".tum", ".txt"})


def report(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="WHAT", help="A map, a drive, or a result NAME.json of localise --json."
        ),
    ],
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE.html",
            help="The page [default: WHAT.html here].",
            parser=options.output_page,
        ),
    ] = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Make a report of a map, a drive or a result.

    Writes one HTML file to view and share; it needs no network and runs no script. For a map it
    shows the map from above, its weak spots, drives and history; for a drive, what the doctor
    finds, with stereo pairs; for a result, where the drive was localised, by whose nodes, and the
    gaps. To include pictures of the matches: engram localise MAP DRIVE --report FILE.html.

    \b
    Examples:
      engram report town.engram
      engram report drives/monday --out look.html
      engram report tuesday.json
    """
    from engram.viewing.report import made_by

    place = out or Path(f"{path.name.partition('.')[0] or 'report'}.html")
    if out is None:
        options.output_page(str(place))
    if path.suffix == ".json":
        page = _result_page(path)
    elif path.suffix == ".engram":
        page = _map_page(path, settings)
    else:
        page = _drive_page(path, settings)
    page.write(place, made_by())
    options.show({"report": str(place), "verdict": page.verdict}, f"{place}: {page.verdict}",
                 as_json=as_json)  # fmt: skip


def _result_page(path: Path) -> Page:
    from contextlib import nullcontext

    from engram.robot.results import read_result
    from engram.viewing.report import drive_page, map_at_hand, typed

    result = read_result(path)
    place = result.map or "MAP", result.drive or "DRIVE"
    with map_at_hand(result.map) or nullcontext() as opened:
        lines = [typed("engram", "localise", *place, "--report", path.with_suffix(".html").name)]
        return drive_page(result, opened, None, lines)


def _map_page(path: Path, settings: options.SettingsGiven) -> Page:
    from engram.files import map_path
    from engram.viewing.report import map_page, typed

    town = map_path(str(path))
    lines = [
        typed("engram", "plot", town, "map.png"),
        typed("engram", "weak-spots", town),
        typed("engram", "check", town),
        typed("engram", "log", town),
        f"{typed('engram', 'localise', town)} DRIVE --report monday.html",
    ]
    return map_page(town, lines, settings.read().weak_spots)


def _drive_page(path: Path, settings: options.SettingsGiven) -> Page:
    from engram.cli.screen import Bars
    from engram.frontend.frame import StereoPair
    from engram.robot.mapping import examine_drive
    from engram.viewing.report import examined_page, typed

    changes = [*(settings.changes or ()), "drive.skip_bad=true"]
    sequence, given = options.Seen().open(path, replace(settings, changes=changes))
    resolved = given.of_robot()
    most = min(len(sequence), resolved.doctor.frames)
    pairs: list[StereoPair] = []

    def keep(number: int, arrived: Arrived) -> None:
        if number * _PAIRS // max(most, 1) == len(pairs) and isinstance(arrived, StereoPair):
            pairs.append(arrived)

    with Bars().stage("doctor", most) as monitor:
        diagnosis = examine_drive(sequence, resolved, monitor, seen=keep)
    lines = [
        typed("engram", "doctor", path),
        typed("engram", "map", "MAP.engram", path),
        typed("engram", "localise", "MAP.engram", path, "--report", "monday.html"),
    ]
    return examined_page(str(path), diagnosis, pairs, lines)


@dataclass(frozen=True, slots=True, eq=False)
class _Driven:
    """A path to be evaluated.

    Attributes:
        kind: what it is, for people.
        stamps_ns: (F,) int64 of all frames, ns, which a truth without stamps counts.
        summary: that of a localised drive; None without one.
    """

    kind: str
    path: Trajectory
    stamps_ns: NDArray[np.int64]
    summary: DriveSummary | None = None


def evaluate(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="DRIVE",
            help="A drive, a result NAME.json of localise --json, or a trajectory NAME.tum.",
        ),
    ],
    *,
    truth: Annotated[
        Path,
        typer.Option(
            "--truth", metavar="FILE", help="Poses of the left camera, TUM or KITTI format."
        ),
    ],
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Compare a drive with its ground truth.

    Prints the absolute error (ATE, after a rigid alignment) and the relative error (RPE) as evo
    does. For a drive it evaluates the odometry; for a result, the poses in the map, with the share
    of frames localised and the longest gap. Poses are compared at stamps at most 10 ms apart.
    KITTI's format has no stamps: one line for each frame.

    \b
    Examples:
      engram evaluate drives/tuesday --truth drives/tuesday.truth.txt
      engram evaluate tuesday.json --truth drives/tuesday.truth.txt
      engram evaluate tuesday.tum --truth poses/06.txt --json
    """
    from engram.evaluation import evaluate as compare

    driven = _driven(path, settings)
    found = compare(driven.path, read_truth(truth, driven.stamps_ns))
    plain = {"kind": driven.kind, **found.to_dict()}
    if driven.summary is not None:
        plain["share_localised"] = driven.summary.share_localised
        plain["longest_gap_m"] = driven.summary.longest_gap_m
    options.show(plain, partial(_text, path, driven, found), as_json=as_json)


def read_truth(path: Path, stamps_ns: NDArray[np.int64]) -> Trajectory:
    """A file of true poses in TUM's format, or in KITTI's, which has a line for each stamp.

    Args:
        stamps_ns: (F,) int64 of all frames of the drive, ns.
    """
    from engram.sequences.motion_files import read_kitti_poses, read_rows, read_tum

    fields = max(read_rows(path, len), default=0)
    return read_kitti_poses(path, stamps_ns) if fields == 12 else read_tum(path)


def _driven(path: Path, settings: options.SettingsGiven) -> _Driven:
    import numpy as np

    from engram.cli.screen import Bars
    from engram.robot.results import odometry_trajectory, read_result
    from engram.sequences.motion_files import read_tum

    if path.suffix == ".json":
        result = read_result(path)
        stamps_ns = np.array([one.stamp_ns for one in result.frames], np.int64)
        return _Driven("result", result.trajectory(str(path)), stamps_ns, result.summary)
    if path.suffix in _TRAJECTORIES:
        trajectory = read_tum(path)
        return _Driven("trajectory", trajectory, trajectory.stamps_ns)
    sequence, given = options.Seen().open(path, settings)
    with Bars().stage("odometry", len(sequence)) as monitor:
        return _Driven("odometry", *odometry_trajectory(sequence, given.of_robot(), monitor))


def _text(path: Path, driven: _Driven, found: Evaluation) -> str:
    lines = [f"{path}, {driven.kind}: {found.text()}"]
    if driven.summary is not None:
        lines.append(
            f"localised {driven.summary.share_localised:.1%} of the frames, longest stretch "
            f"without a match {driven.summary.longest_gap_m:.1f} m"
        )
    return "\n".join(lines)
