"""Stereo pair → frame; frame ↔ frame matching and relative pose. Independent of maps."""

from engram.frontend.features import FEATURES, FeatureKind, feature_kind
from engram.frontend.frame import (
    BRIEF,
    TEBLID,
    DescriptorKind,
    Frame,
    FrameStatus,
    Landmarks,
    StereoPair,
)
from engram.frontend.frontend import Frontend, FrontendConfig, check_pair
from engram.frontend.matching import Match, MatcherConfig, match_frames, matcher_hash, pair_seed

__all__ = [
    "BRIEF",
    "FEATURES",
    "TEBLID",
    "DescriptorKind",
    "FeatureKind",
    "Frame",
    "FrameStatus",
    "Frontend",
    "FrontendConfig",
    "Landmarks",
    "Match",
    "MatcherConfig",
    "StereoPair",
    "check_pair",
    "feature_kind",
    "match_frames",
    "matcher_hash",
    "pair_seed",
]
