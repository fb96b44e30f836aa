"""Two short simulated drives that ship with Engram: `engram try` maps one and localises the other.

Monday's drive is in the sun. Tuesday's, by the same robot, is under clouds; it begins 7 m further
on and ends 7 m further on. `python -m engram_lab.demo.sample_drives` renders them.
"""
