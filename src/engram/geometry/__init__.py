"""Rigid transforms and cameras. Knows nothing of images."""

from engram.geometry.cameras import CameraId, StereoCamera
from engram.geometry.se3 import SE3, propagate_covariance, skew

__all__ = ["SE3", "CameraId", "StereoCamera", "propagate_covariance", "skew"]
