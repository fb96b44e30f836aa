"""Readers of drives: images in known layouts, and frame logs."""

from engram.sequences.frame_range import FrameRange
from engram.sequences.framelog import FrameLog, FrameLogHeader, FrameLogWriter
from engram.sequences.identity import first_pair_hash, session_of
from engram.sequences.image_sequence import ImageSequence
from engram.sequences.opening import SEQUENCES, open_sequence
from engram.sequences.sequence import FrameSequence, LoggedFrame, SequenceInfo, StereoSequence

__all__ = [
    "SEQUENCES",
    "FrameLog",
    "FrameLogHeader",
    "FrameLogWriter",
    "FrameRange",
    "FrameSequence",
    "ImageSequence",
    "LoggedFrame",
    "SequenceInfo",
    "StereoSequence",
    "first_pair_hash",
    "open_sequence",
    "session_of",
]
