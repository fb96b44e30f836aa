"""Merging robots' maps into the fleet's."""

from engram.fleet.merge.gate import Gate, what_is_worse
from engram.fleet.merge.geometry import GeometryGate
from engram.fleet.merge.merging import merge
from engram.fleet.merge.report import MergeReport, Reason, RunReport, Seed, SegmentReport
from engram.fleet.merge.settings import NO_RELOCALISER, MergeOptions

__all__ = [
    "NO_RELOCALISER",
    "Gate",
    "GeometryGate",
    "MergeOptions",
    "MergeReport",
    "Reason",
    "RunReport",
    "Seed",
    "SegmentReport",
    "merge",
    "what_is_worse",
]
