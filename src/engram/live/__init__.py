"""Engram as a process of its own: frames in, poses and status out, whatever happens.

A `Transport` brings frames and commands and takes messages away; `LiveProcess` is the loop between.
A robot's middleware talks to it through `engram.live.link`, which needs nothing but NumPy.
"""

from engram.live.driving import LiveOptions
from engram.live.process import LiveProcess
from engram.live.served import Served
from engram.live.transport import Command, FrameEvent, Played, Transport

__all__ = [
    "Command",
    "FrameEvent",
    "LiveOptions",
    "LiveProcess",
    "Played",
    "Served",
    "Transport",
]
