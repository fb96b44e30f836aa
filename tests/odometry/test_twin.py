"""The core's odometry beside its twin in NumPy, and on every instruction set."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator

import numpy as np
import pytest
from tests.instruction_sets import printed
from tests.odometry.test_odometry import INTERVAL_NS, drive, unusable
from tests.reference.odometry import Odometry as Twin

from engram.frontend.frame import Frame
from engram.geometry.se3 import SE3
from engram.odometry.odometry import Odometry, OdometryConfig, WindowConfig
from engram.odometry.step import Guess, OdometryStep

# Both call the same kernels; what is between them rounds differently, 1e-12 m at most. The
# optimisation stops by its cost, and may amplify that.
WITHIN = 1e-9


def eventful() -> Iterator[Frame]:
    """An unusable frame, a stop of the camera, another place, a return, a stop at once."""
    here, _ = drive(12, 3)
    there, _ = drive(4, 4, offset_px=0.2)
    here[4] = unusable(here[4])
    order = [*here, *there, *here[::-1], *[here[0]] * 4, *here[:4]]
    late = (7, 20)  # a camera that stops for seconds: once it comes back to the same place
    stamp_ns = 0
    for k, frame in enumerate(order):
        stamp_ns += INTERVAL_NS * (40 if k in late else 1)
        yield dataclasses.replace(frame, stamp_ns=stamp_ns)


def digest(steps: list[OdometryStep]) -> str:
    parts = hashlib.sha256()
    for step in steps:
        parts.update(step.status.encode())
        if step.prev_from_curr is not None and step.covariance is not None:
            parts.update(step.prev_from_curr.matrix().tobytes() + step.covariance.tobytes())
    return parts.hexdigest()


@pytest.mark.parametrize(
    "config",
    [
        OdometryConfig(),
        OdometryConfig(window=WindowConfig(iterations=0)),
        OdometryConfig(window=WindowConfig(frames=2, landmarks=60), keyframe_flow_px=3.0),
    ],
)
def test_agrees_with_the_twin_in_python(config: OdometryConfig) -> None:
    core, twin = Odometry(config), Twin(config)
    guess = Guess(SE3.exp([0.0, 0.0, 0.4, 0.0, 0.01, 0.0]), np.eye(6) * 0.01, 0.1)
    statuses = set()
    for frame in eventful():
        ours, theirs = core.step(frame, guess), twin.step(frame, guess)
        statuses.add(ours.status)
        assert (ours.status, ours.inliers) == (theirs.status, theirs.inliers)
        if ours.prev_from_curr is not None and theirs.prev_from_curr is not None:
            off = (ours.prev_from_curr @ theirs.prev_from_curr.inverse()).log()
            assert np.abs(off).max() < WITHIN
            np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-6, atol=1e-15)
    assert len(statuses) == 4


def test_same_bits_on_every_instruction_set() -> None:
    code = """
import sys
sys.path.insert(0, sys.argv[1])
from tests.odometry.test_twin import Odometry, digest, eventful
odometry = Odometry()
print(digest([odometry.step(frame) for frame in eventful()]))
"""
    assert len(printed(code)) == 1
