"""Calibrations of stereo pairs: formats of files, and what a drive makes of them."""

from engram.calibration.cameras import Cameras
from engram.calibration.reading import CALIBRATIONS, read_calibration
from engram.calibration.toml import calibration_toml

__all__ = ["CALIBRATIONS", "Cameras", "calibration_toml", "read_calibration"]
