"""Satellite fixes propose where a lost robot is; a match decides."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.sequences.bag_maker import StereoBag, bag, made, rectified_infos

from engram.frontend.frame import Frame
from engram.live.driving import LiveOptions
from engram.live.process import LiveProcess
from engram.live.served import Command, FrameEvent
from engram.localiser.relocalisation import Exhaustive, Suggested
from engram.maps.map import open_map
from engram.robot.anchors import LatestFix, anchor_map
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_on
from engram.sequences.bags.fixes import Fix, read_fixes
from engram.sequences.opening import open_drive

START_NS = 1_700_000_000_000_000_000
METRES_PER_DEGREE = 111_320 * float(np.cos(np.deg2rad(50.0)))


def fix_at(time_ns: int, east_m: float = 0.0) -> Fix:
    return Fix(time_ns, 50.0, 14.0 + east_m / METRES_PER_DEGREE, None, 1.0)


def test_the_newest_fix_counts_until_it_is_old() -> None:
    latest = LatestFix(iter([fix_at(10), fix_at(20, 1.0)]))
    assert latest(9) is None
    assert latest(10) == fix_at(10)
    assert latest(25) == fix_at(20, 1.0)
    assert latest(20 + 2_000_000_001) is None


def test_suggested_nodes_take_half_of_the_attempts_and_are_not_repeated() -> None:
    class Graph:
        def __len__(self) -> int:
            return 40

        def holds(self, index: int) -> bool:
            return index < 40

    finder = Suggested(Exhaustive(Graph(), None), lambda _: [30, 20, 10])  # type: ignore[arg-type]
    frame: Frame = None  # type: ignore[assignment]
    first = finder.propose(frame, 4, lambda _: True)
    assert first[:2] == [30, 20]
    assert len(first) == len(set(first)) == 4
    finder.failed(first)
    assert finder.propose(frame, 4, lambda _: True)[0] == 10
    finder.forget()
    assert finder.propose(frame, 4, lambda node: node != 30)[0] == 20


@pytest.fixture(scope="module")
def anchored(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of the street along a circle of latitude."""
    folder = tmp_path_factory.mktemp("anchored")
    path = folder / "street.engram"
    map_drive(path, open_drive(street, frames="::2", recorded_at=START_NS))
    with open_map(path) as opened:
        lines = [
            f"{node.id},50.0,{14 + opened.frame.pose(node.id).translation[0] / METRES_PER_DEGREE}"
            for node in opened.graph.nodes
        ]
    given = folder / "gps.csv"
    given.write_text("\n".join(["node,lat,lon", *lines]))
    anchor_map(path, given, author="tests")
    return path


class Script:
    """A transport that brings what it was given."""

    def __init__(self, given: list[FrameEvent | Command | None]) -> None:
        self.given = given
        self.heard: list[dict[str, Any]] = []

    def events(self) -> Iterator[FrameEvent | Command | None]:
        return iter(self.given)

    def tell(self, message: dict[str, Any]) -> None:
        self.heard.append(message)


@pytest.mark.parametrize("east_m", [0.0, 500.0])
def test_a_live_robot_is_found_by_its_fix(anchored: Path, street: Path, east_m: float) -> None:
    frames = [
        FrameEvent(pair, time.perf_counter())
        for pair in open_drive(street, frames="5::2", recorded_at=START_NS)
    ]
    with open_map(anchored) as opened:
        at_m = opened.layout().positions[len(opened.graph) // 2 :, 0].min() + east_m
    fix = {"stamp_ns": frames[0].arrived.stamp_ns, "latitude_deg": 50.0, "sigma_m": 1.0}
    told = {**fix, "longitude_deg": 14.0 + at_m / METRES_PER_DEGREE}
    script = Script([Command("fix", told), Command("fix", {**told, "sigma_m": -1.0}), *frames])
    options = LiveOptions(anchored, robot=RobotOptions(relocaliser=None, threads=3))
    LiveProcess(script, options).run()
    statuses = [one["status"] for one in script.heard if one["is"] == "seen"]
    assert ("localised" in statuses) == (east_m == 0.0)
    assert [one["ok"] for one in script.heard if one["is"] == "reply"] == [True, False]


def test_the_fixes_of_a_wrong_clock_keep_their_order_and_their_times(tmp_path: Path) -> None:
    second_ns, hour_ns = 10**9, 3600 * 10**9
    true_ns = [START_NS + number * second_ns for number in range(24)]
    stamps_ns = [one - hour_ns * (number >= 12) for number, one in enumerate(true_ns)]
    stamps_ns[5] = 0
    with bag(tmp_path / "drive", "mcap") as maker:
        for number, (stamp_ns, received_ns) in enumerate(zip(stamps_ns, true_ns, strict=True)):
            maker.fix("/gps/fix", stamp_ns, (50.0, 14.0 + number), received_ns=received_ns)
    found = read_fixes(made(tmp_path / "drive", "mcap"))
    assert [one.time_ns for one in found] == true_ns[:5] + true_ns[6:]
    assert [one.longitude_deg - 14.0 for one in found] == [n for n in range(24) if n != 5]


@pytest.mark.parametrize("sigmas", [3.0, 0.0])
def test_a_robot_without_recognition_is_found_by_its_fixes(
    sigmas: float, anchored: Path, street: Path, tmp_path: Path
) -> None:
    live = open_drive(street, frames="5::2", recorded_at=START_NS)
    pairs = [(pair.stamp_ns, pair.left, pair.right) for pair in live]
    with open_map(anchored) as opened:
        middle = opened.layout().positions[len(opened.graph) // 2 :, 0].min()
    drive = StereoBag(pairs, rectified_infos(live.camera))
    with bag(tmp_path / "drive", "mcap") as maker:
        for number, (stamp_ns, *images) in enumerate(pairs):
            for side, image in enumerate(images):
                drive._write(maker, number, stamp_ns, side, image)
            maker.fix("/gps/fix", stamp_ns, (50.0, 14.0 + middle / METRES_PER_DEGREE))
    settings = Settings()
    settings = replace(settings, localiser=replace(settings.localiser, fix_sigmas=sigmas))
    options = RobotOptions(relocaliser=None)
    sequence = open_drive(made(tmp_path / "drive", "mcap"))
    with open_map(anchored) as opened, robot_on(opened, sequence, settings, options) as robot:
        found = [one.localised for one in robot.drive(sequence)]
    assert any(found) == (sigmas > 0)
