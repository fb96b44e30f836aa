"""Readers of drives: images in known layouts, ROS bags, and frame logs."""

from engram.sequences.layouts import ImageDrive
from engram.sequences.opening import SequenceFormat, layout_named, open_images
from engram.sequences.sequence import OpenOptions, SequenceInfo

__all__ = [
    "ImageDrive",
    "OpenOptions",
    "SequenceFormat",
    "SequenceInfo",
    "layout_named",
    "open_images",
]
