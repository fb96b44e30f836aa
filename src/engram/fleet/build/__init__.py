"""Building one map of many drives in parallel."""

from engram.fleet.build.building import build_map

__all__ = ["build_map"]
