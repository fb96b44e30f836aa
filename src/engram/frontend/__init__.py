"""Stereo pair → frame; frame ↔ frame matching and relative pose. Knows nothing of maps."""

from engram.frontend.frame import DescriptorKind, Frame, FrameStatus, Landmarks, StereoPair

__all__ = ["DescriptorKind", "Frame", "FrameStatus", "Landmarks", "StereoPair"]
