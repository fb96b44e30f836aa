"""How much of its route a robot misses by each kind of features: short drives of other days.

    python -m engram_lab.checks.kinds_on_drives --kinds brief,net

Of each town of the clips (`engram_lab.studies.faults.clips`) the first three drives are mapped, and
the other three localised there: with two attempts a frame ranked by `recall`, and with so many that
nearly every node about is tried.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from engram.frontend.frame import DescriptorKind
from engram.maps.map import Map
from engram.measures import route_not_localised
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import measure
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.faults.clips import JUDGING, SETTING, ClipDrive, missing

_MAPPED = 3
BUDGETS = {
    "two attempts": RobotOptions(lanes=2, rounds=1),
    "everything tried": RobotOptions(lanes=8, rounds=8),
}


def towns() -> dict[str, list[ClipDrive]]:
    """The drives of each town whose clips are all in the cache, in the order of their plan."""
    plans: dict[str, list[ClipDrive]] = {}
    absent = {f"{plan.rig} {plan.town}" for plan in missing([*SETTING, *JUDGING])}
    for plan in [*SETTING, *JUDGING]:
        town = f"{plan.rig} {plan.town}"
        if town not in absent and plan.rig != "kitti":  # clips of a third of the length
            plans.setdefault(town, []).append(ClipDrive(plan, plan.read().pairs))
    return plans


def figures(kind: str, relocaliser: str) -> Iterator[Figure]:
    """Route missed of all towns' drives, in per cent, and of each town's."""
    settings = Settings().for_descriptor(DescriptorKind(kind))
    every: dict[str, list[float]] = {name: [] for name in BUDGETS}
    for town, drives in towns().items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "town.engram"
            for drive in drives[:_MAPPED]:
                map_drive(path, drive, settings, RobotOptions(force=True))
            with Map.open(path) as opened:
                for name, budget in BUDGETS.items():
                    options = replace(budget, relocaliser=relocaliser)
                    missed = 100 * route_not_localised(
                        [measure(opened, drive, settings, options) for drive in drives[_MAPPED:]]
                    )
                    every[name].append(missed)
                    yield Figure(f"{kind}, {town}, {name}: route missed", round(missed, 1), "%")
    for name, values in every.items():
        mean = sum(values) / len(values)
        yield Figure(f"{kind}, mean of {len(values)} towns, {name}: route missed", mean, "%")


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--kinds", default="brief,net", help="joined by commas")
    parser.add_argument("--relocaliser", default="fabmap", help="finds a lost robot")
    asked = parser.parse_args()
    for kind in asked.kinds.split(","):
        report(figures(kind, asked.relocaliser), asked.json)


if __name__ == "__main__":
    main()
