"""What wheels and gyroscope measured at the time of a frame, as a client gives it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from engram.geometry import SE3
from engram.odometry import OutsideMotion


@dataclass(frozen=True, slots=True, eq=False)
class Outside:
    """Where wheels and gyroscope see the camera; what counts is how it changes.

    Attributes:
        wheels_from_live: its pose by wheel odometry, in a frame that stays; None without wheels.
        gyro_from_live: its rotation by a gyroscope, in a frame that stays, as a pose without a
            translation; None without one. It replaces the rotation of the wheels.
    """

    wheels_from_live: SE3 | None = None
    gyro_from_live: SE3 | None = None

    def since(self, before: Outside, seconds: float) -> OutsideMotion | None:
        """The motion since an earlier frame by what was there at both; None for nothing.

        Frames that repeat a stamp, or go back, measure nothing: there is no rate without time.

        The bias is still in it. What wheels measure at the camera holds the turn of its mounting
        by the wheels: the error is the length of the mounting times that of the turn.
        """
        if seconds <= 0:
            return None
        wheels = _between(before.wheels_from_live, self.wheels_from_live)
        gyro = _between(before.gyro_from_live, self.gyro_from_live)
        if gyro is None:
            return None if wheels is None else OutsideMotion(wheels, seconds)
        way = np.zeros(3) if wheels is None else wheels.translation
        rates_rad_s = gyro.log()[3:] / seconds
        return OutsideMotion(SE3(gyro.rotation, way), seconds, wheels is not None, rates_rad_s)


def _between(before: SE3 | None, after: SE3 | None) -> SE3 | None:
    return None if before is None or after is None else before.inverse() @ after
