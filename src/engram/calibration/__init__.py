"""Calibrations of stereo pairs: formats of files, and what a drive makes of them."""

from engram.calibration.calibrated_pair import Cameras

__all__ = ["Cameras"]
