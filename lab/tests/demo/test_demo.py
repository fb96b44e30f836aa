"""The demo: what it tells, and the drives that ship."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from uuid import UUID

import cv2
import numpy as np
import pytest
from tests.pages import check_page

import engram
from engram.frontend.frontend import make_thumbnail
from engram.geometry.se3 import SE3
from engram.graph.model import CameraId, Clock, NodeId, Session, SessionId
from engram.localiser.localisation import Localisation, LocalisationStatus
from engram.robot.mapping import MapReport
from engram.sample import drives
from engram.viewing.drawings import map_above
from engram_lab.demo.sample_drives import PARTS, encoded, write_facts
from engram_lab.demo.story import (
    LIMITS,
    DemoReport,
    Judged,
    LaterDrive,
    MappedDrive,
    Rendered,
    _why,
    demo_campaign,
    run_demo,
)
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.session import SimulatedDrive, SimulatedSequence

SHIPPED = Path(drives.__file__).parent / "data"


@pytest.mark.parametrize("name", PARTS)
def test_calibration_stamps_and_truth_are_those_of_the_program(name: str, tmp_path: Path) -> None:
    write_facts(PARTS[name], tmp_path / name)
    for file in (f"{name}/calibration.toml", f"{name}/times.txt"):
        assert (SHIPPED / file).read_text() == (tmp_path / file).read_text()
    truths = [np.loadtxt(folder / f"{name}.truth.txt") for folder in (SHIPPED, tmp_path)]
    np.testing.assert_allclose(*truths, atol=1e-6)


@pytest.mark.parametrize("name", PARTS)
def test_images_are_those_of_the_program(name: str) -> None:
    for number, pair in enumerate(PARTS[name].pairs(2)):
        for side in ("left", "right"):
            shipped = cv2.imread(str(SHIPPED / name / side / f"{number:06d}.jpg"), -1)
            body = np.frombuffer(encoded(getattr(pair, side)), np.uint8)
            rendered = cv2.imdecode(body, -1)
            # Equal here; another JPEG library or processor may round otherwise.
            assert np.abs(shipped.astype(int) - rendered).mean() < 0.5


def test_the_drives_that_ship_are_whole_and_small() -> None:
    assert {one.name for one in drives.DRIVES} == PARTS.keys()
    files = [one for one in SHIPPED.rglob("*") if one.is_file()]
    assert len([one for one in files if one.suffix == ".jpg"]) == 2 * 2 * 40
    assert sum(one.stat().st_size for one in files) < 6.5e6


@pytest.mark.parametrize(
    ("share", "saved", "weak", "first", "says"),
    [
        (0.0, 90, 0, True, "empty"),
        (1.0, 0, 0, False, "nothing new"),
        (0.95, 80, 75, False, "weakly"),
        (0.82, 74, 60, False, "weakly"),
        (0.2, 90, 5, False, "much of it unlike before"),
        (0.8, 30, 5, False, "most of it known"),
    ],
)
def test_every_row_says_why(share, saved, weak, first, says) -> None:
    assert says in _why(share, saved, weak, first=first)


def test_drives_begin_where_odometry_can_follow() -> None:
    """Behind the bend that the route begins in: 23° from the first frame to the second."""
    for number in range(len(demo_campaign().sessions)):
        first, second, *_ = SimulatedDrive(demo_campaign(), number).world_from_cams()
        assert abs(np.rad2deg((first.inverse() @ second).yaw_rad)) < 5
    first, second, *_ = SimulatedDrive(replace(demo_campaign(), begins_m=0.0), 0).world_from_cams()
    assert abs(np.rad2deg((first.inverse() @ second).yaw_rad)) > 20


def test_fixes_are_judged_by_the_truth() -> None:
    """One fix 3 cm off, one 2 m, one turned by 6°; a frame without a fix does not count."""
    world_from_cam = {1: SE3.exp([1, 2, 3, 0.1, 0.2, 0.3]), 2: SE3.exp([2, 1, 3, 0.3, 0.2, 0.1])}
    node_from_live = world_from_cam[1].inverse() @ world_from_cam[2]
    off = [SE3.exp([0.03, 0, 0, 0, 0, 0]), SE3.exp([0, 0, 2.0, 0, 0, 0])]
    off += [SE3.exp([0, 0, 0, 0, np.deg2rad(6), 0])]
    none = Localisation(2, LocalisationStatus.LOST, 0, 0, 0.0)
    fixes = [
        replace(none, status=LocalisationStatus.LOCALISED, node_stamp_ns=1,
                node_from_live=node_from_live @ one)
        for one in off
    ]  # fmt: skip
    judged = Judged.of([*fixes, none], world_from_cam)
    assert judged.false == 2
    assert sorted(judged.error_m) == pytest.approx([0.0, 0.03, 2.0], abs=1e-9)
    assert judged.text() == "median error 3.0 cm, 2 of 3 matches false"
    assert (judged + judged).false == 4
    assert Judged.of([none], world_from_cam).text() == "median error – cm, 0 of 0 matches false"


def test_the_accuracy_counts_each_drive_once() -> None:
    def run(drive: str, where: str, error_m: float, false: int) -> LaterDrive:
        judged = Judged((error_m,) * 10, false)
        return LaterDrive(drive, where, "recall", 4, {}, judged, 50.0, 1.0, {})

    mapped = MappedDrive("monday", 0.5, 10, 0, "", 20, Judged((0.01,) * 10, 1))
    own, fleet = run("night", "its own map", 0.2, 2), run("night", "the fleet's map", 0.03, 0)
    other = run("night", "the fleet's map", 0.01, 4)
    report = DemoReport(Path(), Path(), mapped=[mapped], shared=[own, fleet], ranked=[fleet, other])
    assert "median error 2.0 cm, 1 of 20 matches false" in report.accuracy()
    assert "all runs above: 7." in report.accuracy()


def test_frames_that_add_nothing_are_accounted_for() -> None:
    lost = Localisation(1, LocalisationStatus.LOST, 0, 0, 0.0)
    kept = replace(lost, saved=NodeId(UUID(int=1)))
    session = Session(
        SessionId(UUID(int=2)), "wildcat", CameraId(UUID(int=3)), 0, Clock.RELATIVE, None
    )
    mapped = MapReport(session, results=[kept, kept, lost])
    row = MappedDrive.of("monday", mapped, Judged((), 0), first=True).row()
    assert row == ("monday", "0 of 3", "0", "2", "map was empty; 1 skipped")


def test_the_demo_is_the_hamlet_with_a_second_night_and_scout() -> None:
    demo, hamlet = demo_campaign(), campaign_named("hamlet")
    assert [one.start for one in demo.sessions] == sorted(one.start for one in demo.sessions)
    assert [a.seed for a in demo.sessions] == [b.seed for b in hamlet.sessions]
    assert [one.name for one in demo.sessions] == [
        "000-0714T0830-clear-wildcat", "001-0714T1700-clear-courier",
        "002-0715T1100-overcast-wildcat", "003-0715T2230-night-wildcat",
        "004-0716T2245-night-courier", "005-0717T0900-fair-scout",
    ]  # fmt: skip
    assert hamlet.sessions[3].name == "003-0715T2230-fair-wildcat"
    assert demo.sessions[4].weather == demo.sessions[3].weather
    assert demo.first_day == hamlet.first_day


def test_logs_name_their_robots_and_no_two_have_one_calibration() -> None:
    """Equal calibrations count as one camera, whose disparities have one error."""
    sequences = [SimulatedSequence(demo_campaign(), number) for number in range(6)]
    cameras = {one.info.robot: one.camera for one in sequences}
    assert cameras.keys() == {"wildcat", "courier", "scout"}
    assert len(set(cameras.values())) == 3
    assert SimulatedSequence(campaign_named("hamlet"), 0).info.robot == "wildcat@hamlet-1"


def test_the_figures_of_real_images_are_those_of_the_docs() -> None:
    evidence = (Path(__file__).parents[3] / "docs/evidence.md").read_text(encoding="utf-8")
    rows = [line for line in evidence.splitlines() if line.startswith("|")]
    for named in ("100 %, median error 1.05 cm", "97.6 % within 0.25 m"):
        assert named in LIMITS
        assert sum(named in row for row in rows) == 1


def test_whole_images_are_rendered_when_they_are_asked_for() -> None:
    drive = SimulatedDrive(demo_campaign(), 0)
    (pair,) = drive.frames(7, 8)
    images = Rendered([drive])
    found = images.find(pair.stamp_ns, make_thumbnail(pair.left))
    assert found is not None
    np.testing.assert_array_equal(found, pair.left)
    assert images.find(pair.stamp_ns, 255 - make_thumbnail(pair.left)) is None
    assert images.find(pair.stamp_ns + 1, make_thumbnail(pair.left)) is None


@pytest.mark.long
def test_the_demo_shows_that_sharing_pays(tmp_path: Path) -> None:
    report = run_demo(tmp_path / "demo")
    localised = {(one.map, one.drive[-5:]): one.summary for one in report.shared}
    own, fleets = (
        localised[name, "urier"]["share_localised"] for name in ("its own map", "the fleet's map")
    )
    assert fleets > own + 0.2
    assert localised["the fleet's map", "scout"]["share_localised"] > 0.9
    assert sum(one.new + one.weak for one in report.mapped) == sum(report.taken.values()) + sum(
        report.covered.values()
    )
    starts = [one.drive for one in report.mapped]
    assert starts == sorted(
        starts, key=lambda one: ("Mon", "Tue").index(one[:3]) * 100 + int(one[4:6])
    )
    for one in report.shared:
        assert len(one.judged.error_m) == one.summary["statuses"]["localised"] > 0
        assert one.judged.false == 0
    with engram.open_map(report.out / "fleet.engram") as fleet:
        assert map_above(fleet).sizes() == [sum(report.taken.values())]
    assert all(sum(one.matched.values()) == len(one.judged.error_m) for one in report.shared)
    ranked = {(one.policy, one.attempts): one for one in report.ranked}
    by_recall, by_distance = ranked["recall", 4], ranked["distance", 4]
    assert by_recall is report.shared[1]
    # What the words below the table say.
    recall, distance = by_recall.summary, by_distance.summary
    assert recall["share_localised"] > distance["share_localised"]
    assert recall["attempts_per_frame"] < distance["attempts_per_frame"]
    assert by_recall.node_m > by_distance.node_m
    assert np.median(by_recall.judged.error_m) > np.median(by_distance.judged.error_m)
    for table in report.tables():
        widths = [max(map(len, column)) for column in zip(table.head, *table.rows, strict=True)]
        assert sum(widths) + 2 * len(widths) <= 80
    read = check_page(report.page.read_text(), most_bytes=3_000_000)
    captions = [one["alt"] for one in read.of("img")]
    assert sum("inliers" in one for one in captions) >= 6
    assert report.to_dict()["page"] == str(report.page)
