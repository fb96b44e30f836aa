"""[G16]'s experiments: building in parallel, sharing, downloads, orders of merging (method §8)."""

from engram_lab.studies.fleet.arms import ARMS, Arm, arms_for
from engram_lab.studies.fleet.experiments import fleet_tasks, run_fleet
from engram_lab.studies.fleet.plan import FleetOptions, FleetPlan, Protocol, make_fleet_plan
from engram_lab.studies.fleet.report import write_fleet_report

__all__ = [
    "ARMS",
    "Arm",
    "FleetOptions",
    "FleetPlan",
    "Protocol",
    "arms_for",
    "fleet_tasks",
    "make_fleet_plan",
    "run_fleet",
    "write_fleet_report",
]
