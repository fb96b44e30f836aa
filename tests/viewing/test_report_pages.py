"""Reports: self-contained pages, readable by all, that show what strangers wrote as text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.pages import HOSTILE, check_page

import engram
from engram.frontend.frontend import make_thumbnail
from engram.geometry.se3 import SE3
from engram.sample.drives import write_drives
from engram.viewing import report
from engram.viewing.drawings import BY_ODOMETRY, NOWHERE, Course, as_svg, draw_strip
from engram.viewing.matches import NeighbouringDrives, ShownMatch, _relative, shows
from engram.viewing.page import Page, commands, figures, paragraph, photograph, table


def test_texts_of_strangers_are_text() -> None:
    match = photograph(b"x", HOSTILE, HOSTILE)
    parts = [
        paragraph(HOSTILE), figures([(HOSTILE, HOSTILE)]), commands([HOSTILE]), match,
        table([HOSTILE], [[HOSTILE]], HOSTILE),
    ]  # fmt: skip
    read = check_page(Page(HOSTILE, HOSTILE, parts).html(HOSTILE))
    assert len(read.of("img")) == 1
    assert sum(HOSTILE in word for word in read.words) >= 8


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the two drives that ship, and a map of the first."""
    folder = tmp_path_factory.mktemp("street")
    write_drives(folder)
    engram.map_drive(folder / "street.engram", engram.open_drive(folder / "monday"))
    return folder


def shown(frame: int, at_m: float) -> ShownMatch:
    return ShownMatch(frame, (0, 0), at_m, lambda: np.zeros((4, 4, 3), np.uint8), "", "")


def test_the_pictures_of_a_page_lie_apart_and_are_the_best() -> None:
    shelf = report._Shelf()
    for frame, score in enumerate([5, 9, 7, 1, 2, 8, 3, 6, 4, 10] * 4):
        at_m = frame * 2.0
        if shelf.has_room(score, at_m):
            shelf.put(score, shown(frame, at_m))
    assert [one.score for one in shelf.kept] == [10, 10, 10]
    at_m = [one.shown.at_m for one in shelf.kept]
    assert min(abs(a - b) for a in at_m for b in at_m if a != b) >= report._APART_M


def test_whole_images_are_those_that_look_like_the_small_ones(street: Path) -> None:
    monday = engram.open_drive(street / "monday")
    pair, other = monday.read(3), monday.read(30)
    near = NeighbouringDrives(street / "tuesday")
    found = near.find(pair.stamp_ns, make_thumbnail(pair.left))
    np.testing.assert_array_equal(found, pair.left)
    assert near.find(pair.stamp_ns, make_thumbnail(other.left)) is None
    assert near.find(pair.stamp_ns + 1, make_thumbnail(pair.left)) is None
    assert not shows(pair.left, make_thumbnail(pair.left)[1:])


def test_captions_say_where_the_robot_was() -> None:
    def at(x: float, z: float, yaw_deg: float = 0.0) -> str:
        turn = SE3.exp([0, 0, 0, 0, np.deg2rad(yaw_deg), 0]).rotation
        return _relative(SE3(turn, np.array([x, 0.0, z])))

    assert at(0.1, 1.2) == "1.2 m ahead"
    assert at(-0.8, -2.0) == "2.0 m behind, 0.8 m to the left"
    assert at(0.0, 1.0, 20.0) == "1.0 m ahead, turned 20° right"


def test_a_strip_has_the_runs_and_gaps_of_a_drive() -> None:
    names = ["a", "a", BY_ODOMETRY, NOWHERE, "b", BY_ODOMETRY]
    localised = np.array([name in {"a", "b"} for name in names])
    at_m = np.array([0.0, 10.0, 20.0, 30.0, 45.0, 50.0])
    nowhere = np.full((6, 2), np.nan)
    course = Course(at_m, names, np.arange(6.0), localised, nowhere)
    assert course.runs() == [
        ("a", 0, 1), (BY_ODOMETRY, 2, 2), (NOWHERE, 3, 3), ("b", 4, 4), (BY_ODOMETRY, 5, 5),
    ]  # fmt: skip
    assert course.gaps() == [(0.0, 10.0), (10.0, 45.0), (45.0, 50.0)]
    drawn = as_svg(draw_strip(course), "a strip")
    assert "35 m" in drawn
    empty = Course(at_m[:0], [], at_m[:0], localised[:0], nowhere[:0])
    assert "<svg" in as_svg(draw_strip(empty), "an empty drive")
