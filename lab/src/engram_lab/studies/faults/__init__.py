"""Injected faults: what a robot claims when its camera, its clock or its map is wrong."""
