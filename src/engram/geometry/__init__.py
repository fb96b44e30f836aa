"""Rigid transforms and cameras.

`engram.geometry.rectification` is not imported here, since it imports OpenCV, which is slow.
"""

from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3

__all__ = ["SE3", "StereoCamera"]
