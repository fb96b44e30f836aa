"""A robot in a map of another lens: how much of its route it misses, with the lens known or not.

    python -m engram_lab.checks.lenses TOWN...      # folders of frame logs

The first log of each town is mapped. Every drive of a robot with another lens is localised there,
with one attempt a frame, and with four: what is missed then is not the ranking's fault.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

from engram.maps import Map
from engram.measures import route_not_localised
from engram.robot import RobotOptions, Settings, map_drive, measure, open_drive

BUDGETS = {"one attempt": (1, 1), "four": (2, 2)}


def missed(centre: Path, drive: Path, depth_m: float, budget: tuple[int, int]) -> float:
    """Share of a drive's route that is not localised."""
    settings = Settings()
    localiser = replace(settings.localiser, lens_depth_m=depth_m)
    options = RobotOptions(lanes=budget[0], rounds=budget[1])
    with Map.open(centre) as opened:
        settings = replace(settings, localiser=localiser)
        return route_not_localised([measure(opened, open_drive(drive), settings, options)])


def main() -> None:
    """Prints a line for each drive, lens ignored and known."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("towns", type=Path, nargs="+")
    known_m = Settings().localiser.lens_depth_m
    for town in parser.parse_args().towns:
        first, *others = sorted(town.glob("*.framelog"))
        lens_px = open_drive(first).camera.fx
        with tempfile.TemporaryDirectory() as folder:
            centre = Path(folder) / "centre.engram"
            map_drive(centre, open_drive(first), Settings(), RobotOptions())
            for drive in (one for one in others if open_drive(one).camera.fx != lens_px):
                told = ", ".join(
                    f"{name}: {missed(centre, drive, 0.0, budget):.2%} → "
                    f"{missed(centre, drive, known_m, budget):.2%}"
                    for name, budget in BUDGETS.items()
                )
                print(f"{town.name} {drive.stem}: {told}", flush=True)


if __name__ == "__main__":
    main()
