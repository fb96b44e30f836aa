"""Engram as a process of its own: frames in, poses and status out, whatever happens.

A `Transport` brings frames and commands and takes messages away; `LiveProcess` is the loop between.
A robot's middleware talks to it through `engram.live.link`, which needs nothing but NumPy.
"""
