"""Readers of drives: images in known layouts, ROS bags, and frame logs."""

from engram.sequences.bags import BagSequence
from engram.sequences.framelog import FrameLog, FrameLogHeader, FrameLogWriter
from engram.sequences.image_sequence import ImageDrive, ImageSequence
from engram.sequences.opening import (
    SEQUENCES,
    Drive,
    SequenceFormat,
    layout_named,
    layout_names,
    open_drive,
    open_images,
    stamps_of,
)
from engram.sequences.options import FrameRange, OpenOptions
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
    "ImageDrive",
    "ImageSequence",
    "LoggedFrame",
    "OpenOptions",
    "SequenceFormat",
    "SequenceInfo",
    "StereoSequence",
    "check_name",
    "first_pair_hash",
    "layout_named",
    "layout_names",
    "open_drive",
    "open_images",
    "session_of",
    "stamps_of",
]
