"""Readers of drives: images in known layouts, and frame logs."""

from engram.sequences.framelog import FrameLog, FrameLogHeader, FrameLogWriter
from engram.sequences.image_sequence import ImageSequence
from engram.sequences.opening import SEQUENCES, open_sequence
from engram.sequences.options import FrameRange
from engram.sequences.sequence import (
    FrameSequence,
    LoggedFrame,
    SequenceInfo,
    StereoSequence,
    first_pair_hash,
    session_of,
)

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
