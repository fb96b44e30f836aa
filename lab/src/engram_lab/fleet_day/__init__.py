"""A fleet's day: robots of the town, a centre, and a link that breaks."""

from engram_lab.fleet_day.day import DayReport, run_day

__all__ = ["DayReport", "run_day"]
