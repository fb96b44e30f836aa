"""A robot in a map of another lens: how much of its route it misses, with the lens known or not.

    python -m engram_lab.checks.lenses TOWN...      # folders of frame logs

The first log of each town is mapped. The first drive of a robot with another lens is localised
there, the lens ignored and known, and the first other drive of the map's own robot, with one
attempt a frame, and with four: what is missed then is not the ranking's fault.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from engram.maps.map import Map
from engram.measures import route_not_localised
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import measure
from engram.sequences.opening import open_drive
from engram_lab.intervals import Array, Resamples

BUDGETS = {"one attempt": (1, 1), "four": (2, 2)}


def missed(centre: Path, drive: Path, depth_m: float, budget: tuple[int, int]) -> float:
    """Share of a drive's route that is not localised."""
    settings = Settings()
    localiser = replace(settings.localiser, lens_depth_m=depth_m)
    options = RobotOptions(lanes=budget[0], rounds=budget[1])
    with Map.open(centre) as opened:
        settings = replace(settings, localiser=localiser)
        return route_not_localised([measure(opened, open_drive(drive), settings, options)])


def of_town(town: Path) -> Array:
    """(2, 3) by budget: missed with the lens ignored, known, and through the map's own lens."""
    first, *others = sorted(town.glob("*.framelog"))
    lens_px, known_m = open_drive(first).camera.fx, Settings().localiser.lens_depth_m
    own = next(one for one in others if open_drive(one).camera.fx == lens_px)
    other = next(one for one in others if open_drive(one).camera.fx != lens_px)
    with tempfile.TemporaryDirectory() as folder:
        centre = Path(folder) / "centre.engram"
        map_drive(centre, open_drive(first), Settings(), RobotOptions())
        rows = [
            [
                missed(centre, drive, depth_m, budget)
                for drive, depth_m in ((other, 0.0), (other, known_m), (own, known_m))
            ]
            for budget in BUDGETS.values()
        ]
    return np.array(rows)


def told(shares: Array) -> str:
    """What four towns came to, (T, 3), with paired intervals over the drives."""
    draws = Resamples.of(len(shares))

    def gone(weights: Array) -> Array:
        ignored, known, own = (weights @ shares).T
        return np.asarray((ignored - known) / (ignored - own))

    spared = draws.interval(lambda weights: weights @ (shares[:, 0] - shares[:, 1]) / len(shares))
    share = draws.interval(gone)
    ignored, known, own = shares.mean(axis=0)
    return (
        f"{ignored:.1%} ignored, {known:.1%} known, {own:.1%} through the map's own lens; spared "
        f"{100 * spared.estimate:.1f} points ({100 * spared.low:.1f} … {100 * spared.high:.1f}), "
        f"{share.estimate:.0%} of the loss ({share.low:.0%} … {share.high:.0%})"
    )


def main() -> None:
    """Prints a line for each town and budget, then all together."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("towns", type=Path, nargs="+")
    found = []
    for town in parser.parse_args().towns:
        found.append(of_town(town))
        for name, (ignored, known, own) in zip(BUDGETS, found[-1], strict=True):
            print(f"{town.name}, {name}: {ignored:.2%} → {known:.2%}, own {own:.2%}", flush=True)
    for at, name in enumerate(BUDGETS):
        print(f"{name}: {told(np.array(found)[:, at])}")


if __name__ == "__main__":
    main()
