"""Stereo pair → frame; frame ↔ frame matching and relative pose. Knows nothing of maps."""

from engram.frontend.frame import DescriptorKind, Frame, FrameStatus, Landmarks, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.frontend.matching import Match, MatcherConfig, match_frames, matcher_hash, pair_seed

__all__ = [
    "DescriptorKind",
    "Frame",
    "FrameStatus",
    "Frontend",
    "FrontendConfig",
    "Landmarks",
    "Match",
    "MatcherConfig",
    "StereoPair",
    "match_frames",
    "matcher_hash",
    "pair_seed",
]
