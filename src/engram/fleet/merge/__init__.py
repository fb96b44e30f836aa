"""Merging robots' maps into the fleet's."""

from engram.fleet.merge.merging import merge

__all__ = ["merge"]
