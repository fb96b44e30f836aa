"""Programs that hold maps and poses against the truth: `python -m engram_lab.checks.NAME`."""
