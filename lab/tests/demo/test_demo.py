"""The demo: what it tells, and the drives that ship."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.pages import check_page

from engram.frontend.frontend import make_thumbnail
from engram.sample import drives
from engram_lab.demo.sample_drives import PARTS, encoded, write_facts
from engram_lab.demo.story import Rendered, _why, demo_campaign, run_demo
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.session import SimulatedDrive

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
        (0.2, 90, 5, False, "an experience of its own"),
        (0.8, 30, 5, False, ""),
    ],
)
def test_rows_that_surprise_have_a_sentence(share, saved, weak, first, says) -> None:
    why = _why(share, saved, weak, first=first)
    assert says in why
    assert bool(why) == bool(says)


def test_the_demo_is_the_hamlet_with_a_second_night() -> None:
    demo, hamlet = demo_campaign(), campaign_named("hamlet")
    assert [one.start for one in demo.sessions] == sorted(one.start for one in demo.sessions)
    assert [a.name == b.name for a, b in zip(demo.sessions, hamlet.sessions, strict=True)] == [
        True, True, True, True, False, True,
    ]  # fmt: skip
    assert demo.sessions[4].weather == demo.sessions[3].weather
    assert demo.first_day == hamlet.first_day


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
    ranked = {(one.policy, one.attempts): one.summary for one in report.ranked}
    assert ranked["recall", 4]["share_localised"] >= ranked["distance", 4]["share_localised"]
    read = check_page(report.page.read_text(), most_bytes=3_000_000)
    captions = [one["alt"] for one in read.of("img")]
    assert sum("inliers" in one for one in captions) >= 6
    assert report.to_dict()["page"] == str(report.page)
