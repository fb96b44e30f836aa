"""The measurement of cold starts, on a campaign of a minute's size."""

import csv
from pathlib import Path

import numpy as np
import pytest
from lab.tests.evaluation.campaigns import write_campaign

from engram_lab.checks import cold_starts

# The road of 24 m in three looks; the drives held out in fold 0 with seed 0 are the first and the
# third: one of a look that the map knows, one of a look that it does not.
LOOKS = (0, 1, 2, 0, 1, 0, 0)
HELD_OUT = [0, 2]


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("campaign")
    write_campaign(folder, LOOKS)
    return folder


def test_folds_part_the_sessions() -> None:
    folds = [cold_starts.fold_of(24, fold, 0) for fold in range(cold_starts.FOLDS)]
    assert sorted(number for fold in folds for number in fold) == list(range(24))
    assert {len(fold) for fold in folds} == {4, 5}


def test_known_looks_are_found_and_unknown_ones_are_not_possible(
    campaign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cold_starts.fold_of(len(LOOKS), 0, 0) == HELD_OUT
    arguments = [str(campaign), str(tmp_path), "--sample", "1"]
    cold_starts.main(arguments)
    told = capsys.readouterr().out
    file = tmp_path / "fold0-seed0-fabmap.csv"
    starts = cold_starts.read_starts(file)
    by_drive = {name: [one for one in starts if one.session == name] for name in ("000", "002")}
    assert all(one.status == "found" and one.error_m < 0.5 for one in by_drive["000"])
    assert {one.status for one in by_drive["002"]} == {"impossible"}
    count = len(by_drive["000"])
    assert count >= 5
    assert f"{count} of {count} (100.00 %)" in told
    assert "1 found among the nodes near by truth, 1 among all nodes" in told
    assert file.with_suffix(".txt").read_text() == told


def test_a_killed_run_goes_on_where_it_stopped(
    campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = [str(campaign), str(tmp_path), "--sample", "0"]
    cold_starts.main(arguments)
    file = tmp_path / "fold0-seed0-fabmap.csv"
    whole = file.read_text()
    lines = whole.splitlines(keepends=True)
    file.write_text("".join(lines[:4]) + lines[4][:7])  # killed within a row
    made = []
    once = cold_starts.cold_start
    monkeypatch.setattr(cold_starts, "cold_start", lambda *a: made.append(a) or once(*a))
    cold_starts.main(arguments)
    assert len(made) == len(lines) - 4
    rows = list(csv.DictReader(whole.splitlines()))
    again = list(csv.DictReader(file.read_text().splitlines()))
    assert again == rows


def test_a_wrong_place_counts_against_it() -> None:
    def start(status: str, error_m: float) -> cold_starts.Start:
        return cold_starts.Start("a", 0, status, 1, 0.0, 1, 50, error_m)

    starts = [start("found", 0.1), start("found", 9.0), start("possible", np.nan)]
    told = cold_starts.summarise(starts, [])
    assert "wrong place believed (> 5 m): 1 of 3" in told
    assert "found within 10 m: 1 of 2" in told
