"""Rigid transforms and cameras. Knows nothing of images.

Rectification stands in `engram.geometry.rectification` and is not imported here: it needs OpenCV,
which is slow to import.
"""

from engram.geometry.cameras import CameraId, StereoCamera
from engram.geometry.se3 import SE3, propagate_covariance, skew

__all__ = ["SE3", "CameraId", "StereoCamera", "propagate_covariance", "skew"]
