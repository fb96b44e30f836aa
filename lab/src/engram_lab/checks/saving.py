"""What saving weak matches brings: right and false fixes of drives mapped in turn, and nodes.

    python -m engram_lab.checks.saving                                   # held-out towns, BRIEF
    python -m engram_lab.checks.saving --towns 407,408 --kind net --json saving.json

The six drives of each town are mapped one after another, and each is judged by the map of those
before it; once as published, once with the default of `mapper.sure_inliers`. Then as by a fleet:
each robot maps one drive into a map of its own, which is merged once the drive was localised in the
fleet map; as published, and with the default of `merge.sure_inliers`. Fixes within 1 m and 5° are
right.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

from engram.fleet.merge.merging import merge
from engram.fleet.merge.settings import MergeOptions
from engram.frontend.frame import BRIEF, DescriptorKind
from engram.localiser.localisation import Localisation
from engram.mapper.mapper import MapperConfig
from engram.maps.map import Map
from engram.robot.mapping import map_drive
from engram.robot.settings import Settings
from engram.robot.starting import robot_on
from engram.sequences.opening import open_drive
from engram_lab.misplaced import FALSE_M, FALSE_RAD
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.studies.drives import EvaluatedDrive, Truth
from engram_lab.trial_towns import HELD_OUT_TOWNS, drives_in, light_of, trial_town

_ROBOT, _FLEET = "one robot", "a fleet"
_LIMITS = {
    _ROBOT: {"as published": 0, "default": MapperConfig().sure_inliers},
    _FLEET: {"as published": 0, "default": MergeOptions().sure_inliers},
}


@dataclass(frozen=True, slots=True)
class Driven:
    """One drive in the map of those before it.

    Attributes:
        town: its seed.
        by, rule: who made the map, by which rule of saving.
        weather: of the drive.
        frames, right, false: how many, and how many of them have a right and a false fix.
        nodes: of the map afterwards.
    """

    town: int
    by: str
    rule: str
    weather: str
    frames: int
    right: int
    false: int
    nodes: int


def judged(found: Iterable[Localisation], live: Truth, nodes: Sequence[Truth]) -> tuple[int, int]:
    """Number of right and of false fixes; stamps of several drives never meet."""
    right = false = 0
    for one in found:
        if one.node_from_live is None or one.node_stamp_ns is None:
            continue
        world_from_live = live.at(one.stamp_ns)
        known = (truth.at(one.node_stamp_ns) for truth in nodes)
        world_from_node = next((pose for pose in known if pose is not None), None)
        assert world_from_live is not None
        assert world_from_node is not None
        off = world_from_live.inverse() @ world_from_node @ one.node_from_live
        is_false = off.distance_m > FALSE_M or off.angle_rad > FALSE_RAD
        right, false = right + (not is_false), false + is_false
    return right, false


def by_one_robot(path: Path, drive: EvaluatedDrive, settings: Settings) -> list[Localisation]:
    """Maps a drive into the robot's map."""
    return map_drive(path, open_drive(drive.path), settings).results


def by_a_fleet(
    path: Path, drive: EvaluatedDrive, settings: Settings, sure_inliers: int
) -> list[Localisation]:
    """Localises a drive in the fleet map, then merges the map that its robot made of it alone."""
    found: list[Localisation] = []
    sequence = open_drive(drive.path)
    if path.exists():
        with Map.open(path) as fleet, robot_on(fleet, sequence, settings) as robot:
            found = list(robot.drive(sequence))
    own = path.with_name(f"{drive.name}.engram")
    if not own.exists():
        map_drive(own, open_drive(drive.path), settings)
    merge(path, [own], replace(MergeOptions(), sure_inliers=sure_inliers), settings=settings)
    return found


def driven(town: int, settings: Settings, folder: Path) -> Iterator[Driven]:
    """All drives of a town but the first, by each method of mapping."""
    drives, plans = drives_in(town, settings), trial_town(town).sessions
    truths = [truth for one in drives if (truth := one.truth()) is not None]
    for by, rule in product(_LIMITS, ("as published", "default")):
        limit, path = _LIMITS[by][rule], folder / f"{by}-{rule}.engram"
        mapper = replace(settings.mapper, sure_inliers=limit)
        for number, (plan, drive) in enumerate(zip(plans, drives, strict=True)):
            if by == _ROBOT:
                found = by_one_robot(path, drive, replace(settings, mapper=mapper))
            else:
                found = by_a_fleet(path, drive, settings, limit)
            with Map.open(path) as made:
                nodes = made.info().nodes
            right, false = judged(found, truths[number], truths)
            if number:
                yield Driven(town, by, rule, light_of(plan), len(found), right, false, nodes)


def figures(rows: Sequence[Driven]) -> Iterator[Figure]:
    """Of each method of mapping: right and false fixes in each weather, nodes in the end."""
    for by, rule in dict.fromkeys((row.by, row.rule) for row in rows):
        some = [row for row in rows if (row.by, row.rule) == (by, rule)]
        nodes = {row.town: row.nodes for row in some}  # after the last drive
        yield Figure(f"{by}, {rule}: nodes of a town", sum(nodes.values()) / len(nodes))
        for weather in sorted({row.weather for row in some}):
            those = [row for row in some if row.weather == weather]
            right = sum(row.right for row in those) / sum(row.frames for row in those)
            yield Figure(f"  {weather}: right", 100 * right, "%")
            yield Figure("    false", sum(row.false for row in those), "fixes")


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--kind", type=DescriptorKind, default=BRIEF, help="of features")
    parser.add_argument("--towns", type=numbers, default=list(HELD_OUT_TOWNS))
    asked = parser.parse_args()
    settings = Settings().for_descriptor(asked.kind)
    rows = []
    for town in asked.towns:
        with tempfile.TemporaryDirectory() as folder:
            for row in driven(town, settings, Path(folder)):
                rows.append(row)
                print(f"{town} {row.by}, {row.rule}, {row.weather}: {row.right} of {row.frames} "
                      f"right, {row.false} false, {row.nodes} nodes", flush=True)  # fmt: skip
    report(figures(rows), asked.json, "maps with weak matches saved")


if __name__ == "__main__":
    main()
