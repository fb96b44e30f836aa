"""The cases: which drives, and what is made of them."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.builders import write_street
from tests.goldens import through
from tests.goldens.results import Case, found_case, measured_case

KITTI_06 = "kitti_odometry/sequences/06"
DRIVE_0001 = "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync"
ROOM = "euroc/V1_01_easy_sparse"
HAMLET = [0, 1, 2, 5]
# Of a download by budget. Files of eight kilobytes more or less hold the same nodes: what
# revisions tell of themselves may change a little.
BUDGET_BYTES = 2_011_000


class DrivesMissingError(Exception):
    """A group's drives are not on this machine."""


@dataclass
class Group:
    """The cases of some drives, computed in the order in which they are asked for.

    Attributes:
        folder: for the maps.
        threads: whether lanes run on threads.
        inputs: hash of each drive, by name.
        only: name of the one case that is wanted; None for all.
    """

    folder: Path
    threads: bool = True
    only: str | None = None
    inputs: dict[str, str] = field(default_factory=dict)
    cases: dict[str, Case] = field(default_factory=dict)

    def drive(self, name: str, path: Path, **how: Any) -> Path:
        """A drive by which the group is made."""
        self.inputs[name] = through.input_hash(through.drive(path, **how))
        return path

    def keep(self, name: str, case: Case) -> None:
        if self.only in {None, name}:
            self.cases[name] = case

    def measure(self, name: str, path: Path, **how: Any) -> None:
        if self.only in {None, name}:
            self.keep(name, measured_case(list(through.measured(through.drive(path, **how)))))

    def map(self, name: str, map_path: Path, path: Path, **how: Any) -> Path:
        sequence = through.drive(path, **how)
        case = found_case(through.map_one(map_path, sequence, threads=self.threads), poses=False)
        case.values = through.contents(map_path)
        self.keep(name, case)
        return map_path

    def localise(
        self, name: str, map_path: Path, path: Path, policy: str = "recall", **how: Any
    ) -> None:
        if self.only in {None, name}:
            sequence = through.drive(path, **how)
            found = through.localise(map_path, sequence, policy=policy, threads=self.threads)
            self.keep(name, found_case(found, poses=policy == "recall"))

    def live(self, name: str, map_path: Path, path: Path, **how: Any) -> None:
        if self.only in {None, name}:
            found = through.live(map_path, through.drive(path, **how))
            self.keep(name, found_case(found, poses=False))

    def merge(self, name: str, centre: Path, *robots: Path) -> Path:
        reports = through.merge(centre, *robots)
        self.keep(name, Case(values={"merges": reports, **through.contents(centre)}))
        return centre

    def send(self, name: str, centre: Path, **options: Any) -> None:
        if self.only in {None, name}:
            out = self.folder / f"{name}.engram"
            report = through.send(centre, out, **options)
            self.keep(name, Case(values={**report, **through.contents(out)}))

    def revert(self, name: str, map_path: Path, revision: int) -> None:
        if self.only in {None, name}:
            copy = self.folder / f"{name}.engram"
            through.copy_map(map_path, copy)
            report = through.revert(copy, revision)
            self.keep(name, Case(values={**report, **through.contents(copy)}))

    def build(self, name: str, drives: list[Path], groups: int) -> None:
        if self.only in {None, name}:
            centre = self.folder / f"{name}.engram"
            report = through.build(centre, drives, groups=groups, threads=self.threads)
            self.keep(name, Case(values={**report, **through.contents(centre)}))


def data(name: str) -> Path:
    named = os.environ.get("ENGRAM_DATA")
    if not named:
        raise DrivesMissingError("ENGRAM_DATA names no folder of real images")
    folder = Path(named) / name
    if not folder.exists():
        raise DrivesMissingError(f"ENGRAM_DATA has no {name}")
    return folder


def street(group: Group) -> None:
    path = group.drive("street", write_street(group.folder / "street", frames=12))
    group.measure("measure", path)
    even = group.map("map", group.folder / "even.engram", path, frames="::2")
    group.localise("localise", even, path, frames="1::2")


def kitti(group: Group) -> None:
    path = group.drive("kitti_06", data(KITTI_06))
    group.measure("measure", path)
    even = group.map("map-even", group.folder / "even.engram", path, frames="::2", robot="even")
    group.localise("localise-odd", even, path, frames="1::2")
    group.live("live-odd", even, path, frames="1::2")
    odd = group.map("map-odd", group.folder / "odd.engram", path, frames="1::2", robot="odd")
    group.merge("merge", group.folder / "centre.engram", even, odd)
    group.map("map-there-and-back", group.folder / "back.engram", path, there_and_back=101)


def raw(group: Group) -> None:
    path = group.drive("grey", data(DRIVE_0001))
    group.drive("colour", path, rig="colour")
    group.measure("measure-colour", path, rig="colour")
    grey = group.map("map-grey", group.folder / "grey.engram", path, robot="grey")
    group.localise("localise-blue", grey, path, rig="colour", channel="blue")
    colour = group.folder / "colour.engram"
    group.map("map-colour", colour, path, rig="colour", robot="colour")
    centre = group.merge("merge", group.folder / "centre.engram", grey, colour)
    group.send("download-copy", centre)


def euroc(group: Group) -> None:
    path = group.drive("room", data(ROOM))
    group.measure("measure", path)
    first = group.map("map-first", group.folder / "first.engram", path, frames=":32", robot="a")
    second = group.map("map-second", group.folder / "second.engram", path, frames="32:", robot="b")
    group.localise("localise-second", first, path, frames="32:")
    group.merge("merge", group.folder / "centre.engram", first, second)


def hamlet(group: Group) -> None:
    logs = through.rendered("hamlet", HAMLET)
    morning, afternoon, overcast, later = (
        group.drive(f"hamlet_{number}", log) for number, log in zip(HAMLET, logs, strict=True)
    )
    robot = group.map("map-first", group.folder / "robot.engram", morning)
    group.map("map-again", robot, overcast)
    group.localise("localise-afternoon", robot, afternoon)
    other = group.map("map-other", group.folder / "other.engram", afternoon)
    centre = group.merge("merge", group.folder / "centre.engram", robot, other)
    group.merge("merge-other-way", group.folder / "way.engram", other, robot)
    for policy in ("recall", "path-near", "path", "distance"):
        group.localise(f"localise-{policy}", centre, later, policy=policy, frames="::3")
    group.send("download-budget", centre, select="budget", budget_bytes=BUDGET_BYTES)
    group.send("download-paths", centre, select="paths", depart_h=8.0, arrive_h=9.0)
    group.send("download-hour", centre, select="tod", depart_h=17.0, window_min=60.0)
    route = through.session_prefix(afternoon)
    group.send("download-route", centre, select="route", route=route, radius_m=0.5)
    group.revert("revert-first", robot, 1)
    group.revert("revert-second", robot, 2)
    group.revert("revert-merge", centre, 2)
    group.map("map-into-centre", centre, later)
    group.build("build", [morning, afternoon, overcast], groups=2)


GROUPS: dict[str, Callable[[Group], None]] = {
    "street": street,
    "kitti": kitti,
    "raw": raw,
    "euroc": euroc,
    "hamlet": hamlet,
}


@contextmanager
def computed(name: str, *, threads: bool = True, only: str | None = None) -> Iterator[Group]:
    """A group's cases as this code computes them.

    Raises:
        DrivesMissingError: its drives are not here.
    """
    with tempfile.TemporaryDirectory(prefix="engram-goldens-") as folder:
        group = Group(Path(folder), threads, only)
        GROUPS[name](group)
        yield group
