"""The fleet: many robots, one centre (SPEC §7): merging, building."""

from engram.fleet.docking import merge_maps
from engram.fleet.gate import Gate, GateOptions, what_is_worse
from engram.fleet.handed_in import HandedIn
from engram.fleet.merging import Progress, merge_map, silent
from engram.fleet.replay import MergeOptions
from engram.fleet.report import MergeReport, Reason, RunReport, Seed, SegmentReport
from engram.fleet.segments import Segment, string_segments

__all__ = [
    "Gate",
    "GateOptions",
    "HandedIn",
    "MergeOptions",
    "MergeReport",
    "Progress",
    "Reason",
    "RunReport",
    "Seed",
    "Segment",
    "SegmentReport",
    "merge_map",
    "merge_maps",
    "silent",
    "string_segments",
    "what_is_worse",
]
