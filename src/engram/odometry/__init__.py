"""Frame stream → motion between successive frames, with covariance."""

from engram.odometry.fixed import FixedConfig, FixedPixels
from engram.odometry.frozen import FrozenConfig
from engram.odometry.motion import UNMOVED, GapConfig, GapFiller, Motion, driven_steps_m
from engram.odometry.odometry import Odometry, OdometryConfig
from engram.odometry.outside import MotionSource, OutsideConfig, OutsideModel, OutsideMotion
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.odometry.window import WindowConfig

__all__ = [
    "UNMOVED",
    "FixedConfig",
    "FixedPixels",
    "FrozenConfig",
    "GapConfig",
    "GapFiller",
    "Motion",
    "MotionSource",
    "Odometry",
    "OdometryConfig",
    "OdometryStatus",
    "OdometryStep",
    "OutsideConfig",
    "OutsideModel",
    "OutsideMotion",
    "WindowConfig",
    "driven_steps_m",
]
