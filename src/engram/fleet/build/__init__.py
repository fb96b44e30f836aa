"""Building one map of many drives in parallel."""

from engram.fleet.build.best_order import find_best_order
from engram.fleet.build.building import BuildOptions, BuildReport, build_map
from engram.fleet.build.group_mapping import GroupResult, GroupTask, map_group
from engram.fleet.build.grouping import GROUPINGS, group_drives
from engram.fleet.build.orders import BestOrder, JudgeOptions, OrderResult, Orders, order_costs

__all__ = [
    "GROUPINGS",
    "BestOrder",
    "BuildOptions",
    "BuildReport",
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
