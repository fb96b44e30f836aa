"""Engram: lifelong visual localisation for fleets of robots with stereo cameras."""

__version__ = "0.1.0"
