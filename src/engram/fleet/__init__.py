"""The fleet: many robots, one centre (SPEC §7): merging, downloading, building."""

from engram.fleet.best_order import find_best_order
from engram.fleet.building import BuildOptions, BuildReport, build_map
from engram.fleet.docking import merge_maps
from engram.fleet.downloading import DownloadReport, download
from engram.fleet.gate import Gate, GateOptions, what_is_worse
from engram.fleet.group_mapping import GroupResult, GroupTask, map_group
from engram.fleet.grouping import GROUPINGS, group_drives
from engram.fleet.handed_in import HandedIn
from engram.fleet.judging import JudgeOptions, Orders
from engram.fleet.merging import Progress, merge_map, silent
from engram.fleet.mission import DownloadOptions, budget_from_text, hour_from_text
from engram.fleet.order_costs import order_costs
from engram.fleet.order_results import BestOrder, OrderResult
from engram.fleet.replay import MergeOptions
from engram.fleet.report import MergeReport, Reason, RunReport, Seed, SegmentReport
from engram.fleet.segments import Segment, string_segments
from engram.fleet.selections import SELECTIONS
from engram.fleet.trial import LeftOut, Trial, TrialSummary, summarise_trials, try_downloads

__all__ = [
    "GROUPINGS",
    "SELECTIONS",
    "BestOrder",
    "BuildOptions",
    "BuildReport",
    "DownloadOptions",
    "DownloadReport",
    "Gate",
    "GateOptions",
    "GroupResult",
    "GroupTask",
    "HandedIn",
    "JudgeOptions",
    "LeftOut",
    "MergeOptions",
    "MergeReport",
    "OrderResult",
    "Orders",
    "Progress",
    "Reason",
    "RunReport",
    "Seed",
    "Segment",
    "SegmentReport",
    "Trial",
    "TrialSummary",
    "budget_from_text",
    "build_map",
    "download",
    "find_best_order",
    "group_drives",
    "hour_from_text",
    "map_group",
    "merge_map",
    "merge_maps",
    "order_costs",
    "silent",
    "string_segments",
    "summarise_trials",
    "try_downloads",
    "what_is_worse",
]
