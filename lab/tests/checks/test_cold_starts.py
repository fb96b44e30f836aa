"""The measurement of cold starts, on a campaign of a minute's size."""

import argparse
import csv
import json
from pathlib import Path

import numpy as np
import pytest
from lab.tests.evaluation.campaigns import write_campaign

from engram.monitor import QUIET
from engram_lab.checks import cold_starts
from engram_lab.studies.drives import DriveSet, split

# The road of 24 m; the drives that fold 0 holds out are one of a look that the map knows, and one
# of a look that it does not.
LOOKS = [0] * 7
KNOWN, UNKNOWN = split(len(LOOKS), cold_starts.FOLDS)[0].held_out
LOOKS[UNKNOWN] = 1


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> DriveSet:
    return write_campaign(tmp_path_factory.mktemp("campaign"), LOOKS)


def asked(out: Path, sample: int) -> argparse.Namespace:
    return argparse.Namespace(
        out=out, fold=0, relocaliser="fabmap", lanes=2, rounds=32, starts=640, sample=sample,
        json=out / "figures.json",
    )  # fmt: skip


def test_known_looks_are_found_and_unknown_ones_are_not_possible(
    campaign: DriveSet, tmp_path: Path
) -> None:
    cold_starts.measure(campaign.drives, asked(tmp_path, 1), QUIET)
    starts = cold_starts.read_starts(tmp_path / "fold0-fabmap.csv")
    known = [one for one in starts if one.session == f"{KNOWN:03d}"]
    assert len(known) >= 5
    assert all(one.status == "found" and one.error_m < 0.5 for one in known)
    unknown = {one.status for one in starts if one.session == f"{UNKNOWN:03d}"}
    assert unknown == {"impossible"}
    (figures,) = json.loads((tmp_path / "figures.json").read_text()).values()
    values = {one["name"]: one["value"] for one in figures}
    assert values["of which can be found within 10 m"] == len(known)
    assert values["found within 10 m"] == 100
    assert values["sampled frames found among the nodes near by truth"] == 1
    assert values["sampled frames found among all nodes"] == 1


@pytest.mark.long
def test_a_killed_run_goes_on_where_it_stopped(
    campaign: DriveSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cold_starts.measure(campaign.drives, asked(tmp_path, 0), QUIET)
    file = tmp_path / "fold0-fabmap.csv"
    whole = file.read_text()
    lines = whole.splitlines(keepends=True)
    file.write_text("".join(lines[:4]) + lines[4][:7])  # killed within a row
    made = []
    once = cold_starts.cold_start
    monkeypatch.setattr(cold_starts, "cold_start", lambda *a: made.append(a) or once(*a))
    cold_starts.measure(campaign.drives, asked(tmp_path, 0), QUIET)
    assert len(made) == len(lines) - 4
    rows = list(csv.DictReader(whole.splitlines()))
    assert list(csv.DictReader(file.read_text().splitlines())) == rows


def test_a_wrong_place_counts_against_it() -> None:
    def start(status: str, error_m: float) -> cold_starts.Start:
        return cold_starts.Start("a", 0, status, 1, 0.0, 1, 50, error_m)

    starts = [start("found", 0.1), start("found", 9.0), start("possible", np.nan)]
    values = {one.name: one.value for one in cold_starts.summarise(starts, [])}
    assert values["wrong place believed (> 5 m)"] == pytest.approx(100 / 3)
    assert values["found within 10 m"] == 50
