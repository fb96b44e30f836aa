"""Both directions of a road: what drives either way miss after one drive each way.

    python -m engram_lab.checks.both_directions SEED SESSION...     # of `longer_trial_town`

The first drive and the first one against it are mapped into one map. Each named drive is localised
there, and in a map of the first drive alone.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from engram.maps import Map
from engram.measures import Drive, route_not_localised
from engram.robot import RobotOptions, Settings, map_drive, measure, open_drive
from engram_lab.intervals import Resamples
from engram_lab.town.simulating import campaigns_folder, simulate
from engram_lab.trial_towns import longer_trial_town


def localised(centre: Path, log: Path) -> Drive:
    """What a robot that starts lost makes of a drive."""
    with Map.open(centre) as opened:
        return measure(opened, open_drive(log), Settings(), RobotOptions())


def main() -> None:
    """Prints a line for each drive, then the two directions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seed", type=int)
    parser.add_argument("sessions", type=int, nargs="+")
    asked = parser.parse_args()
    town = longer_trial_town(asked.seed)
    against = next(one.number for one in town.sessions if one.reverse)
    wanted = sorted({0, against, *asked.sessions})
    files = simulate(town, campaigns_folder(), sessions=wanted).files
    logs = dict(zip(wanted, map(Path, files), strict=True))
    missed: dict[bool, list[float]] = {False: [], True: []}
    with tempfile.TemporaryDirectory() as folder:
        one_way, both = Path(folder) / "one.engram", Path(folder) / "both.engram"
        map_drive(one_way, open_drive(logs[0]), Settings(), RobotOptions())
        for number in (0, against):
            map_drive(both, open_drive(logs[number]), Settings(), RobotOptions())
        for number in asked.sessions:
            plan = town.session(number)
            shares = [
                route_not_localised([localised(where, logs[number])]) for where in (one_way, both)
            ]
            missed[plan.reverse].append(shares[1])
            print(f"{plan.name}: missed {shares[0]:.2%} in a map of one direction, {shares[1]:.2%} "
                  "of both", flush=True)  # fmt: skip
    usual, other = np.array(missed[False]), np.array(missed[True])
    draws = [Resamples.of(len(one), seed=at).counts for at, one in enumerate((usual, other))]
    apart = draws[1] @ other / len(other) - draws[0] @ usual / len(usual)
    low, high = 100 * np.percentile(apart, [5, 95])
    more = 100 * (other.mean() - usual.mean())
    print(f"the usual way {usual.mean():.2%}, against it {other.mean():.2%}: {more:+.2f} points "
          f"({low:.2f} … {high:.2f})")  # fmt: skip


if __name__ == "__main__":
    main()
