"""Merging robots' maps into the fleet's."""

from engram.fleet.merge.gate import Gate, what_is_worse
from engram.fleet.merge.handed_in import HandedIn
from engram.fleet.merge.merging import merge
from engram.fleet.merge.replay import MergeOptions
from engram.fleet.merge.report import MergeReport, Reason, RunReport, Seed, SegmentReport
from engram.fleet.merge.segments import Segment, string_segments

__all__ = [
    "Gate",
    "HandedIn",
    "MergeOptions",
    "MergeReport",
    "Reason",
    "RunReport",
    "Seed",
    "Segment",
    "SegmentReport",
    "merge",
    "string_segments",
    "what_is_worse",
]
