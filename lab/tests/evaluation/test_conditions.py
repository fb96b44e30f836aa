"""What the study of conditions counts."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engram.geometry.se3 import SE3
from engram_lab.studies.conditions import Row, add_rows, longest_gap_m, small_town


def straight(count: int) -> list[SE3]:
    return [SE3(np.eye(3), np.array([0.0, 0.0, 2.0 * k])) for k in range(count)]


@pytest.mark.parametrize(
    ("localised", "gap_m"), [([], 18.0), ([0, 9], 18.0), ([4], 10.0), (list(range(10)), 2.0)]
)
def test_the_longest_gap_counts_from_the_start_and_to_the_end(
    localised: list[int], gap_m: float
) -> None:
    assert longest_gap_m(straight(10), localised) == pytest.approx(gap_m)


def test_a_small_town_has_a_drive_in_each_condition_with_a_seed_of_its_own() -> None:
    town = small_town(22)
    assert {"clear", "overcast", "fair", "rain", "snow"} == {one.weather for one in town.sessions}
    assert len({one.seed for one in town.sessions}) == len(town.sessions)
    assert [one.start for one in town.sessions] == sorted(one.start for one in town.sessions)


def test_rows_of_a_map_replace_those_that_a_table_has_of_it(tmp_path: Path) -> None:
    path = tmp_path / "conditions.csv"
    row = Row("dusk", 100, 97, 1, 2, 15.0, 40.0, 0.8, 2.0, 1.5)
    size = {"nodes": 3, "size_bytes": 4}
    for kind in ("brief", "net"):
        add_rows(path, {"town": "1", "kind": kind}, [row, replace(row, condition="snow")], size)
    add_rows(path, {"town": "1", "kind": "brief"}, [replace(row, right=98)], size)
    with path.open(encoding="utf-8", newline="") as file:
        kept = [(one["kind"], one["condition"], one["right"]) for one in csv.DictReader(file)]
    assert kept == [("net", "dusk", "97"), ("net", "snow", "97"), ("brief", "dusk", "98")]
