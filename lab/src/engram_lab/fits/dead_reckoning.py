"""Holds ways that were driven on odometry alone against the truth.

    engram lab simulate village
    python -m engram_lab.fits.dead_reckoning village                    # the wet drives
    python -m engram_lab.fits.dead_reckoning village --weather clear,snow

From every seventh frame of each drive the robot goes on for so many frames by what odometry
measured and by what was guessed where it failed. Tells how wrong it is then, what it believes to be
wrong, and how often a right match would be refused there: when the position is further off than
half a metre and three standard deviations, or the heading than 5° and three.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from engram.geometry.se3 import SE3
from engram.graph.model import node_id
from engram.localiser.acceptance import AcceptanceConfig
from engram.localiser.localisation import Position
from engram.odometry.motion import GapFiller, Motion
from engram_lab.programs import command_line
from engram_lab.studies.drives import EvaluatedDrive, open_campaign
from engram_lab.town.simulating import campaigns_folder

LENGTHS, EVERY = (7, 14, 28), 7


def widest(covariance: NDArray[np.float64]) -> float:
    """Standard deviation along the least certain axis."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def at_end(covariance: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) of the end point of a path, from the (6, 6) left perturbation of its pose."""
    x, y, z = end
    lever = np.hstack([np.eye(3), -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])])
    moved: NDArray[np.float64] = lever @ covariance @ lever.T
    return moved


def ways(drive: EvaluatedDrive, length: int) -> Iterator[tuple[float, float, float, float]]:
    """Error and standard deviation of each path: metres, metres, radians, radians."""
    truth = drive.truth()
    if truth is None:
        return
    gaps, motions, poses = GapFiller(), list[Motion](), list[SE3 | None]()
    for logged in drive.frames():
        motions.append(gaps.motion(logged.odometry, logged.frame.stamp_ns))
        poses.append(truth.at(logged.frame.stamp_ns))
    for start in range(0, len(poses) - length, EVERY):
        end = start + length
        spanned = motions[end].prev_from_curr is None
        if spanned or (start > 0 and motions[start].prev_from_curr is None):
            continue  # a frame of no use: the next step spans it
        steps = motions[start + 1 : end + 1]
        world_from_start, world_from_end = poses[start], poses[end]
        if world_from_start is None or world_from_end is None:
            continue
        if any(not np.isfinite(one.guessed_m) for one in steps):
            continue  # the robot counts as lost
        there = Position.at(node_id(drive.session.id, 0))
        for one in steps:
            if one.prev_from_curr is not None and one.covariance is not None:
                there = there.carried_on(one.prev_from_curr, one.covariance)
        pose, true = there.node_from_live, world_from_start.inverse() @ world_from_end
        yield (
            float(np.linalg.norm(pose.translation - true.translation)),
            widest(at_end(there.covariance, pose.translation)),
            (true.inverse() @ pose).angle_rad,
            widest(there.covariance[3:, 3:]),
        )


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("campaign")
    parser.add_argument("--weather", default="rain,showers")
    asked = parser.parse_args()
    accepted, kinds = AcceptanceConfig(), asked.weather.split(",")
    drives = open_campaign(asked.campaign, campaigns_folder()).drives
    wanted = [one for one in drives if any(f"-{kind}-" in one.name for kind in kinds)]
    print(f"{asked.campaign}: {len(wanted)} drives in {asked.weather}")
    for length in LENGTHS:
        found = np.array([way for drive in wanted for way in ways(drive, length)])
        if len(found) == 0:
            print(f"{length:3} frames: no way")
            continue
        off_m, sigma_m, off_rad, sigma_rad = found.T
        beyond = (off_m > accepted.slack_m + 3 * sigma_m) | (
            off_rad > accepted.slack_rad + 3 * sigma_rad
        )
        print(
            f"{length:3} frames: off {np.sqrt(np.mean(off_m**2)):.2f} m and "
            f"{np.rad2deg(np.sqrt(np.mean(off_rad**2))):.1f}° (r.m.s.), believed "
            f"{np.median(sigma_m):.2f} m and {np.rad2deg(np.median(sigma_rad)):.1f}° (median); "
            f"{np.mean(beyond):.1%} of {len(found)} ways are further off than is forgiven"
        )


if __name__ == "__main__":
    main()
