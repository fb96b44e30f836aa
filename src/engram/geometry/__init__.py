"""Rigid transforms and cameras.

`engram.geometry.rectification` is not imported here, since it imports OpenCV, which is slow.
"""

from engram.geometry.cameras import CameraId, StereoCamera
from engram.geometry.se3 import SE3, propagate_covariance, skew

__all__ = ["SE3", "CameraId", "StereoCamera", "propagate_covariance", "skew"]
