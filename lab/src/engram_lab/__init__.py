"""Engram's laboratory: the simulated town, the studies, the benches, the fits and the demo."""
