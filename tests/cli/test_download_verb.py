"""`engram download` as its users meet it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from engram.drive import MapOptions, Settings, extract_log, map_drive, open_drive
from engram.errors import SequenceError

KEYS = {
    "out", "policy", "revision", "source_hash", "content_hash", "nodes", "of_nodes", "sessions",
    "partial_paths", "edges", "bridges", "components", "size_bytes", "of_bytes", "why",
    "expected_missed", "copy_missed", "check",
}  # fmt: skip


@pytest.fixture(scope="module")
def centre(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fleet") / "centre.engram"
    sequence = open_drive(street, start="2026-03-01T09:30:00", longitude_deg=0.0)
    map_drive(path, sequence, Settings(), MapOptions())
    return path


@pytest.fixture(scope="module")
def night(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same street by night, of which the centre has seen nothing."""
    log = tmp_path_factory.mktemp("drives") / "night.framelog"
    sequence = open_drive(street, robot="r2", start="2026-03-02T22:30:00", longitude_deg=0.0)
    extract_log(sequence, log, Settings())
    return log


@pytest.fixture(scope="module")
def morning(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The street in the centre's morning."""
    log = tmp_path_factory.mktemp("drives") / "morning.framelog"
    sequence = open_drive(street, robot="r2", start="2026-03-02T09:30:00", longitude_deg=0.0)
    extract_log(sequence, log, Settings())
    return log


def test_it_writes_a_map_and_says_what_it_promises(engram, centre: Path, tmp_path: Path) -> None:
    out = tmp_path / "r1.engram"
    told = engram("download", centre, out, "--policy", "tod", "--start", "9:00", "--json").json
    assert set(told) == KEYS
    assert told["nodes"] == told["of_nodes"] > 0
    assert engram("info", out, "--json").json["content_hash"] == told["content_hash"]
    text = engram("download", centre, tmp_path / "r2.engram", "--policy", "copy").out
    assert "expected share of the way without a match" in text


def test_a_budget_may_be_a_share_of_everything(engram, centre: Path, tmp_path: Path) -> None:
    asked = ("--policy", "budget", "--budget", "80%", "--json")
    told = engram("download", centre, tmp_path / "r1.engram", *asked).json
    assert 0 < told["nodes"] < told["of_nodes"]
    assert (tmp_path / "r1.engram").stat().st_size == told["size_bytes"]
    assert told["size_bytes"] <= 0.8 * told["why"]["everything_bytes"]


def test_a_promise_is_held_against_a_drive(
    engram, centre: Path, street: Path, tmp_path: Path
) -> None:
    asked = ("--policy", "tod", "--start", "9:00", "--window", 700, "--check", street)
    (mine, whole) = engram("download", centre, tmp_path / "a.engram", *asked, "--json").json[
        "check"
    ]
    assert (mine["name"], whole["name"]) == ("tod", "copy")
    # The very images of which the map was made, as of another time.
    assert mine["missed"] == whole["missed"] == 0.0
    # One drive says little of the next: what it saved is believed to serve it half of the time.
    assert 0.3 < mine["expected_missed"] < 0.7


def test_a_drive_that_cannot_be_opened_fails_before_anything_is_written(
    engram, centre: Path, street: Path, tmp_path: Path
) -> None:
    checks = ("--check", street, "--check", tmp_path / "nope.framelog")
    ran = engram("download", centre, tmp_path / "a.engram", *checks)
    assert ran.status == 2
    assert "nope.framelog" in ran.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("robot", [None, "somebody"])
def test_a_drive_that_the_centre_holds_is_refused_before_anything_is_written(
    engram, centre: Path, street: Path, morning: Path, tmp_path: Path, robot: str | None
) -> None:
    known = shutil.copy(centre, tmp_path / "centre.engram")
    map_drive(known, open_drive(morning, robot=robot), Settings(), MapOptions())
    ran = engram("download", known, tmp_path / "out.engram", "--check", morning)
    assert ran.status == 2
    assert f"{morning} is not held out" in ran.err
    assert "--check" in ran.err
    assert not (tmp_path / "out.engram").exists()
    # The revision that is sent did not have it yet.
    asked = ("download", known, tmp_path / "out.engram", "--at", 1, "--check", morning)
    assert engram(*asked).status == 0


def test_a_drive_for_whose_hour_there_is_nothing_is_a_row_of_its_own(
    engram, centre: Path, morning: Path, night: Path, tmp_path: Path
) -> None:
    asked = ("--policy", "tod", "--start", "9:30", "--check", morning, "--check", night)
    ran = engram("download", centre, tmp_path / "a.engram", *asked, "--json")
    assert ran.status == 0
    mine, whole, left_out = ran.json["check"]
    assert (mine["name"], mine["drives"], whole["name"], whole["drives"]) == ("tod", 1, "copy", 1)
    assert (left_out["name"], left_out["drive"]) == ("tod", str(night))
    assert left_out["start_h"] == pytest.approx(22.5, abs=0.01)
    assert "no node was saved within 180 minutes of 22:" in left_out["why"]
    text = engram("download", centre, tmp_path / "b.engram", *asked).out
    assert f"left out {night}, of 22.5 h: no node was saved" in text


def test_a_check_that_fails_leaves_the_download_and_its_report(
    engram, centre: Path, street: Path, tmp_path: Path, monkeypatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise SequenceError("the drive went away")

    monkeypatch.setattr("engram.fleet.try_downloads", fail)
    ran = engram("download", centre, tmp_path / "a.engram", "--check", street, "--json")
    assert ran.status == 2
    assert set(ran.json) == KEYS | {"error"}
    assert ran.json["error"] == {"kind": "SequenceError", "message": "the drive went away"}
    assert engram("check", tmp_path / "a.engram").status == 0
    ran = engram("download", centre, tmp_path / "b.engram", "--check", street)
    assert ran.status == 2
    assert "expected share of the way without a match" in ran.out
    assert "went away" in ran.err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--policy", "best"), "known: copy, tod"),
        (("--policy", "tod"), "needs --start"),
        (("--policy", "tod", "--start", "25:00"), "start is '25:00'"),
        (("--policy", "tod", "--start", "9h"), "start is '9h'"),
        (("--policy", "tod", "--start", "21:00"), "widen the --window"),
        (("--policy", "paths", "--start", "3:00", "--end", "4:00"), "there is some from 9:00"),
        (("--policy", "budget", "--budget", "much"), "budget is 'much'"),
        (("--policy", "budget", "--budget", "0%"), "budget is 0 per cent"),
        (("--policy", "budget", "--budget", "1e2%"), "budget is '1e2%'"),
        (("--policy", "budget", "--budget", "10kB"), "not one node fits into 10000 bytes"),
        (("--policy", "region", "--near", "xyz"), "no UUID"),
        (("--policy", "route", "--route", "00"), "0 sessions begin with '00'"),
        (("--route", "zzzz"), "does not go by --route"),
        (("--policy", "tod", "--start", "9:30", "--budget", "10kB"), "does not go by --budget"),
        (("--policy", "budget", "--budget", "1MB", "--near", "ffffffffff"), "begins with"),
        (("--at", "summer"), "it has no tags"),
    ],
)
def test_mistakes_end_in_one_clear_line(
    engram, centre: Path, tmp_path: Path, arguments, says: str
) -> None:
    ran = engram("download", centre, tmp_path / "out.engram", *arguments)
    assert ran.status == 2
    assert ran.err.startswith("engram: ")
    assert says in ran.err
    assert list(tmp_path.iterdir()) == []
