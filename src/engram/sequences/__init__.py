"""Readers of drives: images in known layouts, ROS bags, and frame logs."""

from engram.sequences.bags import BagSequence
from engram.sequences.framelog import FrameLog, FrameLogHeader, FrameLogWriter
from engram.sequences.image_sequence import ImageSequence
from engram.sequences.opening import SEQUENCES, Drive, open_sequence, stamps_of
from engram.sequences.options import FrameRange, TimeRange
from engram.sequences.sequence import (
    FrameSequence,
    LoggedFrame,
    SequenceInfo,
    StereoSequence,
    check_name,
    first_pair_hash,
    session_of,
)

__all__ = [
    "SEQUENCES",
    "BagSequence",
    "Drive",
    "FrameLog",
    "FrameLogHeader",
    "FrameLogWriter",
    "FrameRange",
    "FrameSequence",
    "ImageSequence",
    "LoggedFrame",
    "SequenceInfo",
    "StereoSequence",
    "TimeRange",
    "check_name",
    "first_pair_hash",
    "open_sequence",
    "session_of",
    "stamps_of",
]
