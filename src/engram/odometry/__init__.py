"""Frame stream → motion between successive frames, with covariance."""

from engram.odometry.odometry import Odometry, OdometryConfig
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.odometry.window import WindowConfig

__all__ = ["Odometry", "OdometryConfig", "OdometryStatus", "OdometryStep", "WindowConfig"]
