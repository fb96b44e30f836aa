"""The story that `engram demo` tells."""

from engram_lab.demo.story import DemoReport, run_demo

__all__ = ["DemoReport", "run_demo"]
