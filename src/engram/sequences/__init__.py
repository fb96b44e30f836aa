"""Readers of drives: images in known layouts, and frame logs."""

from engram.sequences.frame_range import FrameRange
from engram.sequences.image_sequence import ImageSequence, first_pair_hash
from engram.sequences.opening import SEQUENCES, open_sequence
from engram.sequences.sequence import FrameSequence, LoggedFrame, SequenceInfo, StereoSequence

__all__ = [
    "SEQUENCES",
    "FrameRange",
    "FrameSequence",
    "ImageSequence",
    "LoggedFrame",
    "SequenceInfo",
    "StereoSequence",
    "first_pair_hash",
    "open_sequence",
]
