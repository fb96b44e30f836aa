"""How drives are split into groups."""

from __future__ import annotations

from uuid import UUID

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.errors import ConfigError
from engram.fleet.build.building import GROUPINGS, Drive, group_drives
from engram.graph.model import Clock, Session, SessionId
from engram.testing.contracts import CAMERA

HOUR_NS = 3_600_000_000_000


def make_drive(number: int, hour: float, clock: Clock = Clock.UTC) -> Drive:
    start_ns = round((24 * number + hour) * HOUR_NS)
    session = Session(SessionId(UUID(int=number)), "r1", CAMERA, start_ns, clock, longitude_deg=0.0)
    return Drive(f"logs/{number}.framelog", session, 10)


HOURS = (13.0, 23.5, 8.0, 12.5, 0.5, 16.0, 22.0)
DRIVES = [make_drive(number, hour) for number, hour in enumerate(HOURS)]


def numbers(groups: list[list[Drive]]) -> list[list[int]]:
    return [[drive.session.id.int for drive in group] for group in groups]


def test_chronological_groups_are_runs_of_the_order_of_time():
    groups = group_drives(list(reversed(DRIVES)), "chronological", 3, 0)
    assert numbers(groups) == [[0, 1, 2], [3, 4], [5, 6]]


def test_groups_by_condition_hold_like_light():
    groups = group_drives(DRIVES, "by-condition", 3, 0)
    assert numbers(groups) == [[0, 2, 3], [5, 6], [1, 4]]


def test_random_groups_depend_on_the_seed_alone():
    groups = {seed: numbers(group_drives(DRIVES, "random", 3, seed)) for seed in range(5)}
    assert groups[1] == numbers(group_drives(list(reversed(DRIVES)), "random", 3, 1))
    assert len({str(found) for found in groups.values()}) > 1


@given(st.sampled_from(sorted(GROUPINGS)), st.integers(1, len(DRIVES)), st.integers(0, 99))
def test_every_drive_is_in_one_group_and_sizes_are_within_one(grouping, count, seed):
    groups = numbers(group_drives(DRIVES, grouping, count, seed))
    assert sorted(number for group in groups for number in group) == list(range(len(DRIVES)))
    assert len(groups) == count
    assert max(map(len, groups)) - min(map(len, groups)) <= 1
    assert all(group == sorted(group) for group in groups)


def test_a_file_names_the_groups(tmp_path):
    file = tmp_path / "groups.txt"
    file.write_text("# two\n3.framelog 1.framelog\n\n0.framelog 2.framelog 4.framelog # day\n")
    assert numbers(group_drives(DRIVES[:5], str(file), 9, 0)) == [[1, 3], [0, 2, 4]]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0.framelog", "missing"),
        ("0.framelog 1.framelog 0.framelog", "twice"),
        ("0.framelog 1.framelog 7.framelog", "7.framelog"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(tmp_path, text, words):
    file = tmp_path / "groups.txt"
    file.write_text(text)
    with pytest.raises(ConfigError, match=words):
        group_drives(DRIVES[:2], str(file), 1, 0)


def test_what_cannot_be_grouped_is_refused():
    with pytest.raises(ConfigError, match="must be 1 to 7"):
        group_drives(DRIVES, "random", 8, 0)
    with pytest.raises(ConfigError, match="twice"):
        group_drives([DRIVES[0], DRIVES[0]], "random", 1, 0)
    with pytest.raises(ConfigError, match="nonsense"):
        group_drives(DRIVES, "nonsense", 1, 0)
    with pytest.raises(ConfigError, match="hour of day"):
        group_drives([make_drive(0, 1, Clock.RELATIVE)], "by-condition", 1, 0)
