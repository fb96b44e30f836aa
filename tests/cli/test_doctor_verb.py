"""`engram doctor`, and what `map` does with a drive that it finds unfit."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from engram.cli.options import ExitStatus
from engram.maps.map import open_map

UNFIT, EXIT_DAMAGED = 4, 3
NOT_TO_BE_TRUSTED = 5


@pytest.fixture
def swapped(street: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "swapped"
    shutil.copytree(street, folder)
    (folder / "left").rename(folder / "aside")
    (folder / "right").rename(folder / "left")
    (folder / "aside").rename(folder / "right")
    return folder


def test_a_healthy_drive_passes(engram, street: Path) -> None:
    ran = engram("doctor", street)
    assert ran.status == 0
    assert "12 frames examined: nothing wrong" in ran.out
    assert "not checked: scale_off" in ran.out


def test_pairs_are_drawn(engram, street: Path, tmp_path: Path) -> None:
    assert engram("doctor", street, "--pictures", tmp_path / "looks").status == 0
    drawn = sorted((tmp_path / "looks").glob("pair-*.png"))
    assert len(drawn) == 4
    first = cv2.imread(str(drawn[0]))
    assert (first[..., 0] != first[..., 1]).any(), "lines are coloured"


def test_pairs_that_map_refuses_are_a_finding(engram, street: Path, tmp_path: Path) -> None:
    folder = tmp_path / "holes"
    shutil.copytree(street, folder)
    left = sorted(folder.glob("left/*.png"))
    left[3].unlink()
    left[5].write_bytes(b"cut short")
    assert engram("map", tmp_path / "town.engram", folder).status == 2
    ran = engram("doctor", folder, "--json")
    (bad,) = (one for one in ran.json["findings"] if one["code"] == "bad_pairs")
    assert bad["value"] == 2
    assert "image 3 is missing in " in bad["message"]
    assert "drive.skip_bad" in bad["cure"]
    for path in left:
        path.write_bytes(b"cut short")
    assert "bad_pairs" in engram("doctor", folder).out


def test_ten_bits_in_sixteen_are_found(engram, street: Path, tmp_path: Path) -> None:
    folder = tmp_path / "deep"
    shutil.copytree(street, folder)
    for file in folder.glob("*/*.png"):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(file), image.astype(np.uint16) * 4)
    found = {one["code"] for one in engram("doctor", folder, "--json").json["findings"]}
    assert "few_grey_levels" in found


def test_a_fatal_finding_has_an_exit_status_of_its_own(engram, swapped: Path) -> None:
    ran = engram("doctor", swapped, "--json")
    assert ran.status == UNFIT
    assert ran.json["fatal"]
    worst = ran.json["findings"][0]
    assert (worst["code"], worst["severity"]) == ("sides_swapped", "fatal")
    assert worst["value"] > worst["limit"]


def test_stamps_out_of_order_are_a_finding_not_an_error(engram, street: Path, tmp_path) -> None:
    folder = tmp_path / "backwards"
    shutil.copytree(street, folder)
    stamps = (folder / "times.txt").read_text().splitlines()
    stamps[6], stamps[7] = stamps[7], stamps[6]
    (folder / "times.txt").write_text("\n".join(stamps))
    ran = engram("doctor", folder, "--json", "--set", "doctor.faulty_share=0.1")
    assert ran.json["findings"][0]["code"] == "stamps_backwards"
    assert not ran.json["fatal"]
    assert f"1 of {len(stamps)} pairs left out for the stamp" in ran.err


def test_a_drive_with_many_wrong_stamps_is_fatal_to_the_doctor_and_mapped_all_the_same(
    engram, street: Path, tmp_path
) -> None:
    folder = tmp_path / "zeros"
    shutil.copytree(street, folder)
    stamps = (folder / "times.txt").read_text().splitlines()
    wrong = range(3, len(stamps), 6)
    for number in wrong:
        stamps[number] = "0"
    (folder / "times.txt").write_text("\n".join(stamps))
    ran = engram("doctor", folder, "--json")
    assert ran.status == UNFIT
    assert "stamps_unreliable" in {one["code"] for one in ran.json["findings"]}
    told = engram("drive", "info", folder)
    assert told.status == EXIT_DAMAGED
    assert f"{len(wrong)} of {len(stamps)} pairs left out for the stamp" in told.out
    mapped = engram("map", tmp_path / "m.engram", folder)
    assert mapped.status == EXIT_DAMAGED
    assert f"{len(stamps) - len(wrong)} frames" in mapped.out


def test_an_unfit_drive_is_mapped_only_by_force_and_the_revision_says_so(
    engram, swapped: Path, tmp_path: Path
) -> None:
    path = tmp_path / "town.engram"
    refused = engram("map", path, swapped)
    assert refused.status == UNFIT
    assert "sides_swapped" in refused.err
    assert not path.exists()
    forced = engram("map", path, swapped, "--force", "--json")
    assert forced.status == 0
    assert forced.json["findings"][0]["code"] == "sides_swapped"
    with open_map(path) as town:
        (revision,) = town.log()
    assert revision.message.endswith("(forced: sides_swapped)")
    assert revision.configuration["doctor"]["fatal"]


def test_what_is_localised_of_an_unfit_drive_is_not_to_be_trusted(
    engram, street: Path, swapped: Path, tmp_path: Path
) -> None:
    town = tmp_path / "town.engram"
    engram("map", town, street)
    assert engram("localise", town, street, "--json").json["summary"]["trusted"]
    ran = engram("localise", town, swapped, "--json")
    assert ran.status == NOT_TO_BE_TRUSTED
    assert ran.json["summary"]["trusted"] is False
    assert len(ran.json["frames"]) == 12
    assert "not to be trusted: fatal: sides_swapped" in ran.err
    told = engram("localise", town, swapped)
    assert "next: correct the drive (sides_swapped" in told.out


def test_what_is_recorded_of_an_unfit_drive_is_kept_and_said_not_to_be_trusted(
    engram, swapped: Path, tmp_path: Path
) -> None:
    log = tmp_path / "drive.framelog"
    ran = engram("record", swapped, log, "--json")
    assert ran.status == NOT_TO_BE_TRUSTED
    assert ran.json["findings"][0]["code"] == "sides_swapped"
    assert ran.json["frames"] == 12
    assert "not to be trusted: fatal: sides_swapped" in ran.err
    assert log.exists()


def test_a_live_robot_with_an_unfit_drive_says_so_and_commits_nothing(
    engram, street: Path, swapped: Path, tmp_path: Path
) -> None:
    town = tmp_path / "town.engram"
    engram("map", town, street)
    ran = engram("live", town, "--play", swapped, "--map", "--set", "doctor.frames=8")
    assert ran.status == NOT_TO_BE_TRUSTED
    said = [json.loads(line) for line in ran.out.splitlines()]
    seen = [one for one in said if one["is"] == "seen"]
    assert not any("right" in one["trouble"] for one in seen[:7])
    assert all(one["trouble"] for one in seen[8:])
    (ended,) = [one for one in said if one["is"] == "ended"]
    assert ended["unfit"][0] == "sides_swapped"
    assert ended["saving"] == "uncommitted"
    with open_map(town) as store:
        assert store.revision == 1


def test_a_live_robot_that_keeps_nothing_says_that_it_is_not_to_be_trusted(
    engram, street: Path, swapped: Path, tmp_path: Path
) -> None:
    town = tmp_path / "town.engram"
    engram("map", town, street)
    ran = engram("live", town, "--play", swapped, "--set", "doctor.frames=8")
    assert ran.status == NOT_TO_BE_TRUSTED
    seen = [one for one in map(json.loads, ran.out.splitlines()) if one["is"] == "seen"]
    assert seen[-1]["trouble"].startswith("not to be trusted: ")
    sound = engram("live", town, "--play", street)
    assert sound.status == 0


def test_the_statuses_are_those_of_the_documentation() -> None:
    table = (Path(__file__).parents[2] / "docs" / "commands.md").read_text()
    rows = re.findall(r"^\| (\d+) \| (.*) \|$", table, re.M)
    assert [(int(value), meaning) for value, meaning in rows] == [
        (int(one), one.meaning) for one in ExitStatus
    ]
