"""The goldens stand: a part that takes seconds by default, all of them among the long tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from tests.goldens.cases import DrivesMissingError, computed
from tests.goldens.checking import differences
from tests.goldens.results import Case, first_difference

_REAL = pytest.param("kitti", marks=[pytest.mark.data, pytest.mark.long])


@pytest.mark.parametrize("group", ["street", _REAL])
def test_a_drive_gives_what_it_gave(group: str) -> None:
    try:
        with computed(group) as found:
            lines, note = differences(group, found)
    except DrivesMissingError as error:
        pytest.skip(str(error))
    print(note)
    assert not lines, "\n".join(lines)
    if note.startswith("skipped"):
        pytest.skip(note)


@pytest.mark.long
def test_all_drives_give_what_they_gave_by_every_instruction_set() -> None:
    root = Path(__file__).parents[2]
    command = [sys.executable, "-m", "tests.goldens", "check", "--all"]
    run = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr


def case(pose: str = "0.1000000,0.0000000,0.0000000", **values: object) -> Case:
    return Case(["status", "bits", "pose"], ["first 12ab -", f"loc 34cd {pose}"], values)


def test_what_differs_first_is_named() -> None:
    other = case("0.1000001,0.0000000,0.0000000")
    said = first_difference(case(), other, to_the_bit=True)
    assert said is not None
    assert said.startswith("frame 1: pose is 0.1000001")
    assert first_difference(case(), case(), to_the_bit=True) is None
    moved = first_difference(case(records={"nodes": "ab"}), case(records={"nodes": "cd"}),
                             to_the_bit=True)  # fmt: skip
    assert moved == "records.nodes is 'cd', golden 'ab'"


def test_elsewhere_poses_are_compared_within_a_millionth() -> None:
    near, far = case("0.1000009,0.0000000,0.0000000"), case("0.1000020,0.0000000,0.0000000")
    near.rows[0] = "first 98ff -"
    assert first_difference(case(), near, to_the_bit=False) is None
    assert first_difference(case(), far, to_the_bit=False) is not None
    lost = case()
    lost.rows[1] = lost.rows[1].replace("loc", "lost")
    assert first_difference(case(), lost, to_the_bit=False) is not None
    assert first_difference(case(count=1), case(count=2), to_the_bit=False) is not None
