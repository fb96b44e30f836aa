"""Frame stream → motion between successive frames, with covariance."""

from engram.odometry.step import OdometryStatus, OdometryStep

__all__ = ["OdometryStatus", "OdometryStep"]
