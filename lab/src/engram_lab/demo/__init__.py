"""The story of `engram demo`."""
