"""The story of `engram demo`."""

from engram_lab.demo.story import DemoReport, run_demo

__all__ = ["DemoReport", "run_demo"]
