"""`engram evaluate`: a drive against its ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from engram.cli import options

if TYPE_CHECKING:
    from engram.evaluation import Evaluation
    from engram.sequences.motion_files import Trajectory

_TRAJECTORIES = frozenset({".tum", ".txt"})


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
    summary: dict[str, Any] | None = None


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
    does. Of a drive this is the odometry, of a result the poses in the map, with the share of
    frames localised and the longest gap. Poses are compared at stamps at most 10 ms apart. KITTI's
    format has no stamps: one line for each frame.

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
        plain["summary"] = driven.summary
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
            f"localised {driven.summary['share_localised']:.1%} of the frames, longest stretch "
            f"without a match {driven.summary['longest_gap_m']:.1f} m"
        )
    return "\n".join(lines)
