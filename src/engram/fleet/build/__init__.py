"""Building one map of many drives in parallel."""

from engram.fleet.build.best_order import find_best_order
from engram.fleet.build.building import BuildOptions, BuildReport, build_map
from engram.fleet.build.group_mapping import GroupResult, GroupTask, map_group
from engram.fleet.build.grouping import GROUPINGS, group_drives
from engram.fleet.build.judging import JudgeOptions, Orders
from engram.fleet.build.order_costs import order_costs
from engram.fleet.build.order_results import BestOrder, OrderResult

__all__ = [
    "BestOrder",
    "BuildOptions",
    "BuildReport",
    "GROUPINGS",
    "GroupResult",
    "GroupTask",
    "JudgeOptions",
    "OrderResult",
    "Orders",
    "build_map",
    "find_best_order",
    "group_drives",
    "map_group",
    "order_costs",
]
