"""The laboratory's verbs: studies, the town, downloads that are tried."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import pytest
from tests.cli.conftest import engram

from engram.robot.mapping import extract_log, map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive

__all__ = ["engram"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--policies", "distance", "--redo", "path"), "--redo 'path': not among the policies"),
        (("--redo", "nonsense"), "--redo 'nonsense': not among the policies"),
        (("--redo", "path", "--report-only"), "--report-only runs nothing"),
        (("--policies", "distanec"), "no ranking policy 'distanec'"),
        (("--only-folds", "5"), "5"),
        (("hamlet",), "campaign 'hamlet' is given twice"),
        (("--relocaliser", "fabmapp"), "relocaliser 'fabmapp' is unknown"),
        (("--lanes", "0,-1"), "must be whole numbers from 1 on"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_run(
    engram, tmp_path: Path, options: tuple[str, ...], said: str
) -> None:
    ran = engram("lab", "evaluate", "ranking", "hamlet", *options, "--work", tmp_path / "work")
    assert ran.status == 2
    assert said in ran.err
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("hamlett", "hamlett"),
        ("hamlet@x", "the seed after @ must be a whole number"),
        ("hamlet@-1", "-1"),
    ],
)
def test_a_campaign_that_is_none_is_told_as_such(engram, tmp_path: Path, name: str, said: str):
    ran = engram("lab", "evaluate", "ranking", name, "--campaigns", tmp_path / "none")
    assert ran.status == 2
    assert said in ran.err
    assert ("whole number" in ran.err) == ("whole number" in said)


def test_a_campaigns_name_is_the_campaign_though_a_folder_has_it_too(
    engram, tmp_path: Path, monkeypatch
) -> None:
    (tmp_path / "hamlet").mkdir()
    monkeypatch.chdir(tmp_path)
    ran = engram("lab", "evaluate", "ranking", "hamlet", "--campaigns", tmp_path / "none")
    assert ran.status == 2
    assert "sessions are not rendered" in ran.err
    other = engram("lab", "evaluate", "ranking", "hamlet/", "--campaigns", tmp_path / "none")
    assert "is not a frame log" in other.err


__all__ = ["engram"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("bench", "--only", "warp"), "warp"),
        (("simulate", "atlantis"), "atlantis"),
        (("simulate", "hamlet", "--size", "huge"), "huge"),
        (("simulate", "hamlet", "--sessions", "9"), "not 9"),
        (("simulate", "hamlet", "--sessions", "one"), "one"),
        (("simulate", "hamlet", "--sessions", ""), "--sessions ''"),
        (("simulate", "hamlet", "--sessions", "0,"), "--sessions '0,'"),
    ],
)
def test_bad_input_is_one_clear_line_and_status_two(
    engram, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], says: str
) -> None:
    monkeypatch.setenv("ENGRAM_CAMPAIGNS", str(tmp_path))
    ran = engram("lab", *arguments)
    assert ran.status == 2
    assert ran.err.startswith("engram: ")
    assert says in ran.err
    assert "Traceback" not in ran.err


def test_bench_gives_the_documented_json(engram) -> None:
    ran = engram("lab", "bench", "--only", "attempt_512,rank_path_150", "--repeats", 3, "--json")
    stages = ran.json["stages"]
    assert set(stages) == {"attempt_512", "rank_path_150"}
    for stage in stages.values():
        assert {"ms", "p99_ms", "reference_ms", "ratio"} <= set(stage)
        assert math.isfinite(stage["ms"])
    assert ran.json["machine"]


__all__ = ["engram"]


@pytest.fixture(scope="module")
def centre(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fleet") / "centre.engram"
    sequence = open_drive(street, recorded_at="2026-03-01T09:30:00", longitude_deg=0.0)
    map_drive(path, sequence, Settings(), RobotOptions())
    return path


@pytest.fixture(scope="module")
def night(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same street at night, of which the centre has seen nothing."""
    log = tmp_path_factory.mktemp("drives") / "night.framelog"
    sequence = open_drive(street, robot="r2", recorded_at="2026-03-02T22:30:00", longitude_deg=0.0)
    extract_log(sequence, log, Settings())
    return log


@pytest.fixture(scope="module")
def morning(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The street in the centre's morning."""
    log = tmp_path_factory.mktemp("drives") / "morning.framelog"
    sequence = open_drive(street, robot="r2", recorded_at="2026-03-02T09:30:00", longitude_deg=0.0)
    extract_log(sequence, log, Settings())
    return log


def test_a_promise_is_held_against_a_drive(engram, centre: Path, street: Path) -> None:
    asked = ("--select", "tod", "--depart", "9:00", "--window", 700, "--json")
    (mine, whole) = engram("lab", "try", centre, street, *asked).json
    assert (mine["name"], whole["name"]) == ("tod", "copy")
    # The very images of which the map was made, as of another time.
    assert mine["missed"] == whole["missed"] == 0.0
    # One drive says little of the next: what it saved is believed to serve it half of the time.
    assert 0.3 < mine["expected_missed"] < 0.7


@pytest.mark.parametrize("robot", [None, "somebody"])
def test_a_drive_that_the_centre_holds_is_refused(
    engram, centre: Path, morning: Path, tmp_path: Path, robot: str | None
) -> None:
    known = shutil.copy(centre, tmp_path / "centre.engram")
    map_drive(known, open_drive(morning, robot=robot), Settings(), RobotOptions())
    ran = engram("lab", "try", known, morning)
    assert ran.status == 2
    assert f"{morning} is not held out" in ran.err
    # The revision that is sent did not have it yet.
    assert engram("lab", "try", known, morning, "--at", 1).status == 0


def test_a_drive_for_whose_hour_there_is_nothing_is_a_row_of_its_own(
    engram, centre: Path, morning: Path, night: Path
) -> None:
    asked = ("lab", "try", centre, morning, night, "--select", "tod", "--depart", "9:30")
    ran = engram(*asked, "--json")
    assert ran.status == 0
    mine, whole, left_out = ran.json
    assert (mine["name"], mine["drives"], whole["name"], whole["drives"]) == ("tod", 1, "copy", 1)
    assert (left_out["name"], left_out["drive"]) == ("tod", str(night))
    assert left_out["depart_h"] == pytest.approx(22.5, abs=0.01)
    assert "no node was saved within 180 minutes of 22:" in left_out["why"]
    assert f"left out {night}, of 22.5 h: no node was saved" in engram(*asked).out


def test_downloads_and_the_drive_are_as_the_settings_say(
    engram, centre: Path, morning: Path, monkeypatch
) -> None:
    calls = []

    def look(*arguments, **options):
        calls.append(arguments)
        return []

    monkeypatch.setattr("engram_lab.trial.try_downloads", look)
    values = {"window_min": 170.0, "epoch_min": 50.0, "best_percent": 40.0, "buffer_min": 5.0}
    values |= {"widen_min": 30.0, "latitude_deg": 51.0, "radius_m": 25.0}
    given = [f"download.{name}={value}" for name, value in values.items()]
    given += ["drive.ranking=distance", "drive.lanes=3", "drive.rounds=1", "drive.threads=4"]
    asked = [word for one in given for word in ("--set", one)]
    ran = engram("lab", "try", centre, morning, "--select", "tod", "--depart", "9:30", *asked)
    assert ran.status == 0, ran.err
    ((_, wanted, _, _, robot, _),) = calls
    for options in wanted.values():
        assert {name: getattr(options, name) for name in values} == values
    assert (robot.ranking, robot.lanes, robot.rounds, robot.threads) == ("distance", 3, 1, 4)
