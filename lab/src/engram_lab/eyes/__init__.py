"""What descriptors are trained and judged on: scenes, and which corners are truly the same."""

from engram_lab.eyes.corners import Patches, same_corners
from engram_lab.eyes.scenes import Scene, clip, judged_scene, training_scene

__all__ = ["Patches", "Scene", "clip", "judged_scene", "same_corners", "training_scene"]
