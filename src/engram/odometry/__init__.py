"""Frame stream → motion between successive frames, with covariance."""

from engram.odometry.motion import GapFiller, Motion, driven_steps_m, shared_out
from engram.odometry.odometry import Odometry, OdometryConfig
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.odometry.window import WindowConfig

__all__ = [
    "GapFiller",
    "Motion",
    "Odometry",
    "OdometryConfig",
    "OdometryStatus",
    "OdometryStep",
    "WindowConfig",
    "driven_steps_m",
    "shared_out",
]
