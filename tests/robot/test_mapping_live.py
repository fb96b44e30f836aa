"""Mapping live and mapping a recorded drive give the same map."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.builders import write_street
from tests.goldens import through
from tests.goldens.cases import DRIVE_0001, HAMLET, KITTI_06, ROOM, DrivesMissingError, data

from engram.frontend.features import feature_kind
from engram.maps.map import open_map
from engram.robot.drive_session import RobotSetup
from engram.robot.localisers import DriveSequence, session_of_drive
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_in


def street(folder: Path) -> Iterator[DriveSequence]:
    yield through.drive(write_street(folder / "street", frames=12))


def kitti(_: Path) -> Iterator[DriveSequence]:
    path = data(KITTI_06)
    yield through.drive(path, frames="::2", robot="even")
    yield through.drive(path, frames="1::2", robot="odd")
    yield through.drive(path, there_and_back=101)


def raw(_: Path) -> Iterator[DriveSequence]:
    path = data(DRIVE_0001)
    yield through.drive(path, robot="grey")
    yield through.drive(path, rig="colour", robot="colour")


def euroc(_: Path) -> Iterator[DriveSequence]:
    path = data(ROOM)
    yield through.drive(path, frames=":32", robot="a")
    yield through.drive(path, frames="32:", robot="b")


def hamlet(_: Path) -> Iterator[DriveSequence]:
    yield from map(through.drive, through.rendered("hamlet", HAMLET))


def records_live(path: Path, drives: list[DriveSequence]) -> dict[str, str]:
    for drive in drives:
        session, settings = session_of_drive(drive), Settings()
        setup = RobotSetup(drive.camera, settings, RobotOptions(), session.robot, session)
        with open_map(path, create=True) as opened, robot_in(opened, setup, maps=True) as robot:
            for arrived in drive:
                robot.step(arrived)
        assert robot.saving.revision is not None
    return through.contents(path)["records"]


def records_recorded(path: Path, drives: list[DriveSequence]) -> dict[str, str]:
    for drive in drives:
        map_drive(path, drive, Settings(), RobotOptions())
    return through.contents(path)["records"]


@pytest.mark.parametrize(
    "drives",
    [
        street,
        pytest.param(kitti, marks=[pytest.mark.data, pytest.mark.long]),
        pytest.param(raw, marks=[pytest.mark.data, pytest.mark.long]),
        pytest.param(euroc, marks=pytest.mark.data),
        pytest.param(hamlet, marks=pytest.mark.long),
    ],
)
def test_live_and_recorded_mapping_of_the_same_frames_give_the_same_map(
    drives: Callable[[Path], Iterator[DriveSequence]], tmp_path: Path
) -> None:
    try:
        sequences = list(drives(tmp_path))
    except DrivesMissingError as error:
        pytest.skip(str(error))
    live = records_live(tmp_path / "live.engram", sequences)
    recorded = records_recorded(tmp_path / "recorded.engram", sequences)
    assert live["nodes"]
    assert live == recorded


def test_a_new_map_has_the_features_that_are_asked_for(tmp_path: Path) -> None:
    drive = through.drive(write_street(tmp_path / "street", frames=3))
    map_drive(tmp_path / "town.engram", drive, features="net")
    with open_map(tmp_path / "town.engram") as town:
        assert town.descriptor == feature_kind("net").name
