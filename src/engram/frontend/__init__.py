"""Stereo pair → frame; frame ↔ frame matching and relative pose. Independent of maps."""

from engram.frontend.features import FeatureKind, feature_kind
from engram.frontend.frame import DescriptorKind, Frame, StereoPair

__all__ = ["DescriptorKind", "FeatureKind", "Frame", "StereoPair", "feature_kind"]
