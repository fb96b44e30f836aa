"""Dreaming for half an hour: what it adds, and whether drives that it never saw do worse.

    python -m engram_lab.checks.dreams SEED --out FOLDER     # of `longer_trial_town`; resumable

Six robots map one drive each and hand in; the fleet map takes them in the order of time. It dreams
over three validation drives, and three more, which nothing else sees, are localised in it before
and after. Each trio has a drive at night, and the validation one in showers. Run again with the
same folder, the dream continues where its time ended.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from engram.files import draft_folder
from engram.fleet.dream import DreamOptions, dream, gain, localised_in
from engram.fleet.merge.merging import merge
from engram.maps.map import Map
from engram.maps.map_files import copy_map, publish_map
from engram.measures import Drive, route_not_localised
from engram.monitor import QUIET
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive
from engram_lab.town.simulating import campaigns_folder, simulate
from engram_lab.trial_towns import longer_trial_town

HANDED_IN = (0, 1, 2, 4, 5, 6)
VALIDATION = (7, 9, 11)
HELD_OUT = (3, 8, 10)


def made_once(path: Path, make: Callable[[Path], object]) -> Path:
    """A map, unless an earlier run made it already; a killed run leaves none."""
    if not path.exists():
        with draft_folder(path) as drafts:
            make(drafts / path.name)
            publish_map(drafts / path.name, path)
    return path


def robot_of(folder: Path, drive: Path) -> Path:
    """The map of a robot that drove once."""
    return made_once(
        folder / f"{drive.stem}.engram",
        lambda path: map_drive(path, open_drive(drive), Settings(), RobotOptions()),
    )


def merged(path: Path, robots: Sequence[Path]) -> None:
    """Makes the fleet map of some robots' maps."""
    copy_map(robots[0], path)
    merge(path, robots[1:])


def nodes_of(centre: Path) -> int:
    """Nodes of a map."""
    with Map.open(centre) as store:
        return len(store.graph)


def main() -> None:
    """Prints what dreaming came to, then the drives that judge it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seed", type=int)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    wanted = sorted({*HANDED_IN, *VALIDATION, *HELD_OUT})
    files = simulate(longer_trial_town(asked.seed), campaigns_folder(), sessions=wanted).files
    logs = dict(zip(wanted, map(Path, files), strict=True))
    asked.out.mkdir(parents=True, exist_ok=True)
    robots = [robot_of(asked.out, logs[one]) for one in HANDED_IN]
    before = made_once(asked.out / "before.engram", lambda path: merged(path, robots))
    centre = made_once(asked.out / "fleet.engram", lambda path: copy_map(before, path))
    options = DreamOptions(minutes=asked.minutes, workers=asked.workers)
    report = dream(centre, robots, [logs[one] for one in VALIDATION], Settings(), options)
    print(report.text(), f"in {report.seconds / 60:.0f} minutes", sep="\n", flush=True)
    held_out = [logs[one] for one in HELD_OUT]
    judged = localised_in(
        [before, centre], held_out, Settings(), RobotOptions(), asked.workers, QUIET
    )
    print(told(*judged), f"{nodes_of(before)} → {nodes_of(centre)} nodes", sep="\n")


def told(before: Sequence[Drive], after: Sequence[Drive]) -> str:
    """What drives miss that nothing else saw."""
    estimate, low, high = gain(before, after, resamples=2000, level=0.9, seed=0)
    return (
        f"held-out drives miss {route_not_localised(before):.2%} before, "
        f"{route_not_localised(after):.2%} after: better by {100 * estimate:.2f} points "
        f"({100 * low:.2f} … {100 * high:.2f})"
    )


if __name__ == "__main__":
    main()
