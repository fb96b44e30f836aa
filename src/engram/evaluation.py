"""Errors of a trajectory against ground truth: ATE and RPE, as the program evo computes them.

Poses are compared at nearest stamps. The absolute trajectory error (ATE) follows a rigid alignment;
the relative one (RPE) compares the motion between two poses and needs none.

Source: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; the
alignment is that of S. Umeyama, PAMI 13 (1991), without scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError
from engram.geometry.se3 import SE3
from engram.sequences.motion_files import Trajectory

# Stamps further apart than this are not of one pose. Source: evo's default, 10 ms.
TOLERANCE_NS = 10_000_000
# Distances over which the relative error is measured, where the drive is that long, metres.
RELATIVE_M = (10.0, 100.0)
# A rigid alignment needs that many poses.
_LEAST = 3


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Statistics of N errors, in metres or radians."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @staticmethod
    def of(errors: NDArray[np.float64]) -> ErrorStatistics:
        """The statistics of (N,) errors >= 0 in m or rad, N >= 1."""
        return ErrorStatistics(
            rmse=float(np.sqrt(np.mean(errors**2))),
            mean=float(errors.mean()),
            median=float(np.median(errors)),
            std=float(errors.std()),
            min=float(errors.min()),
            max=float(errors.max()),
        )


@dataclass(frozen=True, slots=True)
class RelativeError:
    """The relative error over a distance.

    Attributes:
        over_m: that distance along the true path, metres; None for one pose to the next.
        pairs: pairs of poses compared, none of which overlap.
        offset_m, turn_rad: of the translations, and of the rotations.
    """

    over_m: float | None
    pairs: int
    offset_m: ErrorStatistics
    turn_rad: ErrorStatistics


@dataclass(frozen=True, slots=True)
class Evaluation:
    """How a trajectory differs from the truth.

    Attributes:
        poses: poses of the trajectory.
        compared: those with a true pose at most 10 ms away.
        driven_m: length of the true path through these, metres.
        offset_m, turn_rad: absolute errors after the alignment, metres and radians.
        relative: over one pose, and over the distances of `RELATIVE_M` that fit into the drive.
    """

    poses: int
    compared: int
    driven_m: float
    offset_m: ErrorStatistics
    turn_rad: ErrorStatistics
    relative: tuple[RelativeError, ...]

    def to_dict(self) -> dict[str, Any]:
        """What ``evaluate --json`` prints."""
        return asdict(self)

    def text(self) -> str:
        """What people read."""
        rows = [("ATE", self.offset_m, self.turn_rad)]
        for one in self.relative:
            name = "RPE, pose to pose" if one.over_m is None else f"RPE over {one.over_m:.0f} m"
            rows.append((name, one.offset_m, one.turn_rad))
        lines = [
            f"{self.compared} of {self.poses} poses have a true one, over {self.driven_m:.1f} m",
            f"{'':20}{'rmse':>10}{'median':>10}{'max':>10}{'rmse':>10}",
        ]
        for name, offset, turn in rows:
            metres = "".join(
                f"{value:>8.3f} m" for value in (offset.rmse, offset.median, offset.max)
            )
            lines.append(f"{name:20}{metres}{np.rad2deg(turn.rmse):>9.3f}°")
        return "\n".join(lines)


def evaluate(estimate: Trajectory, truth: Trajectory) -> Evaluation:
    """The errors of a trajectory against the truth; the world frames of the two may differ.

    Raises:
        InputError: fewer than three poses have a true pose at most 10 ms away.
    """
    found, true = associated(estimate, truth)
    if len(found) < _LEAST:
        raise InputError(
            f"{len(found)} of {len(estimate)} poses have a true pose within "
            f"{TOLERANCE_NS / 1e6:.0f} ms, at least {_LEAST} are needed; the estimate's stamps "
            f"are {_span(estimate)}, the truth's {_span(truth)}"
        )
    positions_m, true_m = _positions(found), _positions(true)
    true_from_world = aligned(positions_m, true_m)
    steps_m = np.linalg.norm(np.diff(true_m, axis=0), axis=1)
    pairs: list[tuple[float | None, list[tuple[int, int]]]]
    pairs = [(None, [(i, i + 1) for i in range(len(true) - 1)])]
    pairs += [(over_m, apart(steps_m, over_m)) for over_m in RELATIVE_M]
    offsets_m = np.linalg.norm(true_from_world @ positions_m - true_m, axis=1)
    turns_rad = [
        ((true_from_world @ one).inverse() @ other).angle_rad
        for one, other in zip(found, true, strict=True)
    ]
    return Evaluation(
        poses=len(estimate),
        compared=len(found),
        driven_m=float(steps_m.sum()),
        offset_m=ErrorStatistics.of(offsets_m),
        turn_rad=ErrorStatistics.of(np.array(turns_rad)),
        relative=tuple(_relative(found, true, over_m, some) for over_m, some in pairs if some),
    )


def associated(estimate: Trajectory, truth: Trajectory) -> tuple[list[SE3], list[SE3]]:
    """Poses of both at the same times: of the shorter all, of the longer the nearest to each."""
    swapped = len(estimate) > len(truth)
    shorter, longer = (truth, estimate) if swapped else (estimate, truth)
    pairs = [
        (pose, near)
        for stamp_ns, pose in zip(shorter.stamps_ns, shorter.world_from_cam, strict=True)
        if (near := longer.at(int(stamp_ns), TOLERANCE_NS)) is not None
    ]
    first, second = [one for one, _ in pairs], [other for _, other in pairs]
    return (second, first) if swapped else (first, second)


def aligned(points: NDArray[np.float64], targets: NDArray[np.float64]) -> SE3:
    """The rigid ``target_from_point`` with the least squared distances.

    Args:
        points, targets: (N, 3) float64, the same points in two frames, metres.

    Source: Umeyama 1991, equations 34, 35, 38 to 41, 43.
    """
    mean, target_mean = points.mean(axis=0), targets.mean(axis=0)
    left, _, right = np.linalg.svd((targets - target_mean).T @ (points - mean))
    mirrored = np.linalg.det(left) * np.linalg.det(right) < 0
    rotation = left @ np.diag([1.0, 1.0, -1.0 if mirrored else 1.0]) @ right
    return SE3(rotation, target_mean - rotation @ mean)


def apart(steps_m: NDArray[np.float64], over_m: float) -> list[tuple[int, int]]:
    """Pairs of poses so far apart along the path, one after another.

    Args:
        steps_m: (N,) float64, distance from each pose to the next, metres.
    """
    ends, driven_m = [0], 0.0
    for number, step_m in enumerate(steps_m.tolist(), start=1):
        driven_m += step_m
        if driven_m >= over_m:
            ends.append(number)
            driven_m = 0.0
    return list(pairwise(ends))


def _relative(
    found: Sequence[SE3], true: Sequence[SE3], over_m: float | None, pairs: list[tuple[int, int]]
) -> RelativeError:
    """Source: Sturm et al., equation 1, between given pairs of poses."""
    errors = [
        (true[i].inverse() @ true[j]).inverse() @ (found[i].inverse() @ found[j]) for i, j in pairs
    ]
    return RelativeError(
        over_m,
        len(pairs),
        ErrorStatistics.of(np.array([one.distance_m for one in errors])),
        ErrorStatistics.of(np.array([one.angle_rad for one in errors])),
    )


def _positions(poses: Sequence[SE3]) -> NDArray[np.float64]:
    return np.array([pose.translation for pose in poses], np.float64)


def _span(trajectory: Trajectory) -> str:
    if not len(trajectory):
        return "none"
    first, last = (int(trajectory.stamps_ns[at]) / 1e9 for at in (0, -1))
    return f"{first:.3f} to {last:.3f} s"
