"""Reports: self-contained pages, readable by all, that show what strangers wrote as text."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from tests.pages import HOSTILE, check_page

import engram
from engram.frontend.frontend import make_thumbnail
from engram.geometry.se3 import SE3
from engram.localiser.localisation import LocalisationStatus
from engram.robot.results import DriveResult, DriveSummary, ResultFrame
from engram.sample.drives import write_drives
from engram.viewing import report
from engram.viewing.drawings import (
    BY_ODOMETRY,
    NOWHERE,
    PALETTE,
    UNMEASURED,
    Course,
    as_svg,
    draw_strip,
)
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


def test_a_drive_has_its_colour_of_the_map_unless_two_share_it() -> None:
    localised, places_m = np.ones(2, bool), np.zeros((2, 2))
    course = Course(np.array([1.0, 2.0]), ["b", "c"], np.ones(2), localised, places_m)

    def colours(known: dict[str, str]) -> list[str]:
        _, sure = draw_strip(course, known).axes
        return [line.get_color() for line in sure.lines]

    assert colours({"a": PALETTE[0], "b": PALETTE[3], "c": PALETTE[5]}) == [PALETTE[3], PALETTE[5]]
    assert colours({"b": PALETTE[3], "c": PALETTE[3]}) == [PALETTE[0], PALETTE[1]]
    assert colours({"b": PALETTE[1]}) == [PALETTE[0], PALETTE[1]]


def test_frames_without_a_match_have_no_colour_of_a_drive() -> None:
    """With as many drives as there are colours: hatching and marks tell the others apart."""
    from matplotlib.colors import to_hex

    drives = [f"drive {number}" for number in range(len(PALETTE))]
    names = [*drives, BY_ODOMETRY, NOWHERE, UNMEASURED]
    localised = np.array([name in drives for name in names])
    places_m = np.full((len(names), 2), np.nan)
    course = Course(np.arange(1.0, len(names) + 1), names, np.ones(len(names)), localised, places_m)
    band, sure = draw_strip(course).axes
    legend = [one.get_text() for one in band.get_legend().get_texts()]
    assert legend == names
    looks = dict(zip(names, band.get_legend().legend_handles, strict=True))
    filled = {name: to_hex(looks[name].get_facecolor(), keep_alpha=True) for name in names}
    assert len({(filled[name], looks[name].get_hatch()) for name in names}) == len(names)
    assert not {filled[name][:7] for name in names[-3:] if filled[name][-2:] != "00"} & set(PALETTE)
    (refused,) = [line for line in sure.lines if line.get_label() == "refused"]
    assert refused.get_xdata().tolist() == course.at_m[~localised].tolist()
    assert refused.get_marker() == "x"
    assert to_hex(refused.get_color()) not in PALETTE
    matched = [line for line in sure.lines if len(line.get_xdata()) and line is not refused]
    assert [to_hex(line.get_color()) for line in matched] == list(PALETTE)


def test_every_frame_of_a_drive_is_counted_once() -> None:
    counts = {"localised": 5, "dead_reckoning": 3, "lost": 2, "no_odometry": 1}
    frames = [
        ResultFrame(stamp_ns=number, status=LocalisationStatus(status), step_m=1.0, confidence=1.0)
        for number, status in enumerate(Counter(counts).elements())
    ]
    summary = DriveSummary(
        frames=11, share_localised=5 / 11, statuses=counts, driven_m=11.0, longest_gap_m=6.0,
        p_no_match_10m=0.0, attempts_per_frame=1.0,
    )  # fmt: skip
    result = DriveResult(summary=summary, frames=frames)
    course = report.course_of(result, None)
    assert Counter(course.names) == {"localised": 5, BY_ODOMETRY: 3, NOWHERE: 2, UNMEASURED: 1}
    page = report.drive_page(result, None, None, [])
    parts = re.findall(r"(\d+) (?:of 11 frames localised|by odometry alone|lost|without odometry)",
                       page.verdict)  # fmt: skip
    assert list(map(int, parts)) == [5, 3, 2, 1]
    tiles = dict(report._drive_figures(summary))
    assert [tiles[f"frames {name}"] for name in (BY_ODOMETRY, NOWHERE, UNMEASURED)] == [
        "3", "2", "1",
    ]  # fmt: skip


def test_the_doctor_says_what_it_looked_at() -> None:
    sound = " ".join(report.finding_section([]))
    for subject in ("camera", "calibration", "stamps", "odometry"):
        assert subject in sound
    assert "nothing wrong" in sound
