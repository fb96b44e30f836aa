"""`engram download` as its users meet it."""

from __future__ import annotations

from pathlib import Path

import pytest

from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive

KEYS = {
    "out", "select", "revision", "source_hash", "content_hash", "nodes", "of_nodes", "sessions",
    "partial_paths", "edges", "bridges", "components", "size_bytes", "of_bytes", "why",
    "expected_missed", "copy_missed", "forecast",
}  # fmt: skip


@pytest.fixture(scope="module")
def centre(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fleet") / "centre.engram"
    sequence = open_drive(street, recorded_at="2026-03-01T09:30:00", longitude_deg=0.0)
    map_drive(path, sequence, Settings(), RobotOptions())
    return path


def test_it_writes_a_map_and_says_what_it_promises(engram, centre: Path, tmp_path: Path) -> None:
    out = tmp_path / "r1.engram"
    told = engram("download", centre, out, "--select", "tod", "--depart", "9:00", "--json").json
    assert set(told) == KEYS
    assert told["nodes"] == told["of_nodes"] > 0
    assert engram("info", out, "--json").json["content_hash"] == told["content_hash"]
    text = engram("download", centre, tmp_path / "r2.engram", "--select", "copy").out
    assert "route without a match in 80% of such missions: dry" in text
    assert "nodes left out" not in text  # and no level, which past drives of one map cannot tell


def test_a_budget_may_be_a_share_of_everything(engram, centre: Path, tmp_path: Path) -> None:
    asked = ("--select", "budget", "--budget", "80%", "--json")
    told = engram("download", centre, tmp_path / "r1.engram", *asked).json
    assert 0 < told["nodes"] < told["of_nodes"]
    assert (tmp_path / "r1.engram").stat().st_size == told["size_bytes"]
    assert told["size_bytes"] <= 0.8 * told["why"]["everything_bytes"]
    text = engram("download", centre, tmp_path / "r2.engram", *asked[:-1]).out
    lost = told["expected_missed"] - told["copy_missed"]
    assert f"left out, for comparing downloads: {lost:.1%} of the route" in text


def test_a_robot_keeps_its_map_and_takes_the_download_into_it(
    engram, centre: Path, tmp_path: Path
) -> None:
    out = tmp_path / "r1.engram"
    half = ("--select", "budget", "--budget", "60%")
    assert "budget: " in engram("download", centre, out, *half, "--update").out  # a new file
    before = engram("info", out, "--json").json["nodes"]
    told = engram("download", centre, out, "--update", "--json").json
    assert told["nodes"] == told["of_nodes"] - before > 0
    assert engram("info", out, "--json").json["nodes"] == told["of_nodes"]
    assert "nothing changed" in engram("download", centre, out, "--update").out
    refused = engram("download", centre, out)
    assert refused.status == 2
    assert "exists already" in refused.err


def test_an_hour_without_data_is_widened_and_says_so(engram, centre: Path, tmp_path: Path) -> None:
    asked = ("--select", "tod", "--depart", "21:00")
    text = engram("download", centre, tmp_path / "r1.engram", *asked).out
    assert "nothing was saved within 180 minutes of 21:00: widened to 720 minutes" in text
    told = engram("download", centre, tmp_path / "r2.engram", *asked, "--json").json
    assert told["nodes"] == told["of_nodes"]
    updated = engram("download", centre, tmp_path / "r2.engram", *asked, "--update").out
    assert "nothing changed" in updated
    assert "widened to 720 minutes" in updated
    paths = ("--select", "paths", "--depart", "4:00", "--arrive", "5:00")
    text = engram("download", centre, tmp_path / "r3.engram", *paths).out
    assert "nothing was saved at 4:00 to 5:00: widened to " in text


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--select", "best"), "known: copy, tod"),
        (("--select", "tod"), "needs --depart"),
        (("--select", "tod", "--depart", "25:00"), "depart is '25:00'"),
        (("--select", "tod", "--depart", "9h"), "depart is '9h'"),
        (("--select", "tod", "--depart", "21:00", "--strict"), "window_min"),
        (
            ("--select", "paths", "--depart", "3:00", "--arrive", "4:00", "--strict"),
            "there is some from 9:00",
        ),
        (("--strict",), "does not use --strict"),
        (("--select", "budget", "--budget", "much"), "budget is 'much'"),
        (("--select", "budget", "--budget", "0%"), "budget_percent is 0.0"),
        (("--select", "budget", "--budget", "1e2%"), "budget is '1e2%'"),
        (("--select", "budget", "--budget", "10kB"), "not one node fits into 10000 bytes"),
        (("--select", "region", "--near", "xyz"), "is not a UUID"),
        (("--select", "route", "--route", "00"), "0 sessions begin with '00'"),
        (("--route", "zzzz"), "choose --select tod, paths, tod+paths, route or budget"),
        (("--near", "zzzz"), "does not use --near"),
        (("--select", "tod", "--depart", "9:30", "--budget", "10kB"), "does not use --budget"),
        (("--select", "budget", "--budget", "1MB", "--near", "ffffffffff"), "begins with"),
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
