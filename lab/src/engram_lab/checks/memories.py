"""Robots that only localise: whether their memory, merged, helps `path` on later drives.

    python -m engram_lab.checks.memories SEED SESSION...     # of `longer_trial_town`

Three drives of the town are mapped: by day, at night, and in rain at night. Four more robots each
take a copy of that map, localise in it, and hand in what they remember. The named drives are then
localised in the fleet map with and without these memories: by `path` as published, with one attempt
a frame and with two as in [L15], each also with the paper's settings, by `path-near` with two, and
by `recall`, our default, with one and two. Beside it stands how far ahead or behind the nodes lie
that each attempts first.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from engram.fleet.merge.merging import merge
from engram.maps.map import Map
from engram.maps.map_files import copy_map
from engram.measures import route_not_localised
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings, load_settings
from engram.robot.starting import measured, robot_on
from engram.sequences.opening import open_drive
from engram_lab.intervals import Array, Interval, Resamples
from engram_lab.town.simulating import campaigns_folder, simulate
from engram_lab.trial_towns import longer_trial_town

MAPPED = (0, 3, 5)
REMEMBERED = (1, 2, 4, 6)
# Policy, lanes, and whether the settings are the paper's.
TRIED = (
    ("path", 1, False), ("path", 1, True), ("path", 2, False), ("path", 2, True),
    ("path-near", 2, False), ("recall", 1, False), ("recall", 2, False),
)  # fmt: skip


def handed_in(centre: Path, log: Path, folder: Path) -> Path:
    """The map of a robot that localised one drive in a copy of the fleet map, and remembers it."""
    robot = folder / f"{log.stem}.engram"
    copy_map(centre, robot)
    sequence = open_drive(log)
    with Map.open(robot) as opened, robot_on(
        opened, sequence, Settings(), RobotOptions(), remembers=True
    ) as driving:  # fmt: skip
        for _ in driving.drive(sequence):
            pass
    return robot


def tried(centre: Path, log: Path, policy: str, lanes: int, settings: Settings) -> Array:
    """(2,): share of a drive's route that is missed, mean distance of the first attempts, m."""
    options = RobotOptions(ranking=policy, lanes=lanes, rounds=1)
    found, first_m = [], []
    sequence = open_drive(log)
    with Map.open(centre) as opened, robot_on(opened, sequence, settings, options) as robot:
        for one in robot.drive(sequence):
            found.append(one)
            if outcomes := robot.outcomes:
                expected = outcomes[0].candidate.prediction
                first_m += [] if expected is None else [expected.node_from_live.distance_m]
    return np.array([route_not_localised([measured(found)]), np.mean(first_m)])


def interval(shares: Array) -> Interval:
    """By how much more is missed with memories, (D, 2) without and with, paired over the drives."""
    more = shares[:, 1] - shares[:, 0]
    return Resamples.of(len(more)).interval(lambda weights: weights @ more / len(more))


def main() -> None:
    """Prints a line for each policy and number of lanes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seed", type=int)
    parser.add_argument("sessions", type=int, nargs="+")
    asked = parser.parse_args()
    town = longer_trial_town(asked.seed)
    wanted = sorted({*MAPPED, *REMEMBERED, *asked.sessions})
    files = simulate(town, campaigns_folder(), sessions=wanted).files
    logs = dict(zip(wanted, map(Path, files), strict=True))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        without, with_them = folder / "without.engram", folder / "with.engram"
        for number in MAPPED:
            map_drive(without, open_drive(logs[number]), Settings(), RobotOptions())
        copy_map(without, with_them)
        robots = [handed_in(without, logs[number], folder) for number in REMEMBERED]
        merge(with_them, robots)
        maps = without, with_them
        for policy, lanes, is_paper in TRIED:
            settings = load_settings(Path("linegar2015")) if is_paper else Settings()
            found = np.array(
                [
                    [tried(where, logs[number], policy, lanes, settings) for where in maps]
                    for number in asked.sessions
                ]
            )
            shares, first_m = found[..., 0], found[..., 1].mean(axis=0)
            more = interval(shares)
            told = ", the paper's settings" if is_paper else ""
            print(f"{policy}, {lanes} lanes{told}: missed {shares[:, 0].mean():.2%} without "
                  f"memories, {shares[:, 1].mean():.2%} with: {100 * more.estimate:+.2f} points "
                  f"({100 * more.low:.2f} … {100 * more.high:.2f}); first attempts at "
                  f"{first_m[0]:.2f} and {first_m[1]:.2f} m", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
