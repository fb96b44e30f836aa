"""`engram report` and `--report`: pages of maps, drives and results."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tests.pages import HOSTILE, check_page

import engram as library
from engram.sample.drives import write_drives


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the two drives that ship, and a map of the first."""
    folder = tmp_path_factory.mktemp("street")
    write_drives(folder)
    library.map_drive(folder / "street.engram", library.open_drive(folder / "monday"))
    return folder


def test_a_localised_drive_has_a_page_with_its_matches(engram, street, tmp_path) -> None:
    page = tmp_path / "tuesday.html"
    ran = engram(
        "localise", street / "street.engram", street / "tuesday", "--report", page, "--json"
    )
    assert ran.status == 0
    summary = ran.json["summary"]
    read = check_page(page.read_text())
    said = " ".join(read.words)
    assert f"({summary['share_localised']:.1%})" in said
    assert "Mon 14 Jul 09:30 → Tue 15 Jul 12:00, " in said
    captions = [one["alt"] for one in read.of("img")]
    assert sum("inliers" in one and "no match" not in one for one in captions) >= 2
    assert any("no match" in one for one in captions)
    assert "--explain" in said
    result = tmp_path / "tuesday.json"
    result.write_text(ran.out)
    out = tmp_path / "again.html"
    assert engram("report", result, "--out", out).status == 0
    assert f"({summary['share_localised']:.1%})" in " ".join(check_page(out.read_text()).words)


def test_a_result_of_a_strangers_map_is_shown_as_text(engram, tmp_path) -> None:
    frame = {
        "stamp_ns": 1, "status": "localised", "step_m": 1.0, "confidence": 3.0, "node": HOSTILE,
    }  # fmt: skip
    summary = {
        "frames": 1, "share_localised": 1.0, "statuses": {"localised": 1, "dead_reckoning": 0,
        "lost": 0}, "driven_m": 1.0, "p_no_match_10m": 0.0, "longest_gap_m": 0.0,
        "attempts_per_frame": 1.0, "unusable_frames": 0, "withdrawn": 0, "stages_ms": {},
        "findings": [{"severity": "fatal", "code": HOSTILE, "message": HOSTILE, "value": 1.0,
        "limit": 0.0, "unit": HOSTILE, "cure": HOSTILE}],
    }  # fmt: skip
    whole = {"map": HOSTILE, "drive": HOSTILE, "summary": summary, "frames": [frame]}
    result, out = tmp_path / "result.json", tmp_path / "out.html"
    result.write_text(json.dumps(whole))
    assert engram("report", result, "--out", out).status == 0
    read = check_page(out.read_text())
    assert not read.of("img")
    for damage in ({"frames": "many"}, {"statuses": 3}, {"stages_ms": []}, {"findings": [{}]}):
        result.write_text(json.dumps({**whole, "summary": {**summary, **damage}}))
        ran = engram("report", result, "--out", out)
        assert ran.status == 2, damage
        assert "is not a result" in ran.err


def test_maps_and_drives_have_pages(engram, street: Path, tmp_path: Path) -> None:
    town = tmp_path / "town.engram"
    drive = library.open_drive(street / "monday", robot=HOSTILE[:60], frames="0:12")
    library.map_drive(town, drive)
    out = tmp_path / "town.html"
    shown = engram("report", town, "--out", out, "--json").json
    read = check_page(out.read_text())
    assert shown["report"] == str(out)
    assert shown["verdict"] in " ".join(read.words)
    assert any(HOSTILE[:60] in word for word in read.words)
    looks = tmp_path / "monday.html"
    assert engram("report", street / "monday", "--out", looks).status == 0
    read = check_page(looks.read_text())
    assert len(read.of("img")) == 3
    assert "40 frames examined: nothing wrong." in " ".join(read.words)


def test_a_report_is_a_page(engram, street: Path, tmp_path: Path) -> None:
    for place in (tmp_path / "a.pdf", tmp_path / "no" / "folder.html"):
        ran = engram("report", street / "street.engram", "--out", place)
        assert ran.status == 2
        assert str(place.parent) in ran.err
    assert engram("report", tmp_path / "nothing.engram").status == 2
