"""A fleet's day: robots of the town, a centre, and a link that breaks."""

from engram_lab.fleet_day.day import DayReport, run_day
from engram_lab.fleet_day.robot import Drive, Foray

__all__ = ["DayReport", "Drive", "Foray", "run_day"]
