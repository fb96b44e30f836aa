"""What localisers in step share is what each would have worked out by itself."""

import numpy as np

from engram.geometry import SE3
from engram.odometry import OdometryStatus, OdometryStep
from engram.odometry.motion import GapFiller, Motion
from engram_lab.studies.lockstep import SharedMotion

FRAME_NS = 100_000_000


def measured(x: float) -> OdometryStep:
    step = SE3.exp(np.array([0.0, 0.0, x, 0.0, 0.01, 0.0]))
    return OdometryStep(OdometryStatus.OK, step, np.eye(6) * 1e-4)


def same(one: Motion | None, other: Motion | None) -> bool:
    if one is None or other is None:
        return one is other
    return (
        np.array_equal(one.prev_from_curr.matrix(), other.prev_from_curr.matrix())
        and np.array_equal(one.covariance, other.covariance)
        and one.guessed_m == other.guessed_m
    )


def test_shared_motion_is_everybodys_own() -> None:
    missing = OdometryStep(OdometryStatus.TOO_FEW_MATCHES)
    drive = [OdometryStep(OdometryStatus.FIRST)]
    drive += [measured(1.0 + 0.01 * k) for k in range(6)] + [missing] * 3 + [measured(0.9)]
    stamped = [(step, number * FRAME_NS) for number, step in enumerate(drive)]
    # Where a robot is set down, its frame is a first one once more; one step object may recur.
    stamped.insert(3, (OdometryStep(OdometryStatus.FIRST), stamped[2][1]))
    shared, own = SharedMotion(), [GapFiller() for _ in range(3)]
    for step, stamp_ns in stamped:
        for gaps in own:
            assert same(shared(step, stamp_ns), gaps.motion(step, stamp_ns))
