"""Wrong keywords of the public functions."""

from __future__ import annotations

import dataclasses
import inspect

import pytest
from tests.builders import CAMERA

import engram
from engram.cli.options import Effort
from engram.drive_options import DriveOptions
from engram.keywords import keywords
from engram.maps.map import Map
from engram.robot.settings import RobotOptions

PUBLIC = {
    "open_drive": engram.open_drive,
    "open_map": engram.open_map,
    "map_drive": engram.map_drive,
    "Map.robot": Map.robot,
}


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_function_names_the_keywords_that_it_takes(name):
    function = PUBLIC[name]
    with pytest.raises(engram.EngramError) as refused:
        function(nonsense=1)
    for one in inspect.signature(function).parameters:
        assert one == "self" or one in str(refused.value)
    assert "'nonsense'" in str(refused.value)


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("start", "recorded_at"),
        ("longitude", "longitude_deg"),
        ("field_of_view", "field_of_view_deg"),
        ("calib", "calibration"),
        ("from", "from_"),
    ],
)
def test_a_wrong_keyword_is_answered_with_the_near_one(wrong, right):
    with pytest.raises(engram.EngramError, match=f"did you mean {right}\\?"):
        engram.open_drive("monday", **{wrong: 1})


def test_a_robot_is_given_a_ranking_not_a_policy(tmp_path):
    with (
        engram.open_map(tmp_path / "town.engram", create=True) as opened,
        pytest.raises(engram.EngramError, match="did you mean ranking"),
    ):
        opened.robot(CAMERA, policy="path")


@pytest.mark.parametrize(
    ("options", "function"),
    [(DriveOptions, engram.open_drive), (Effort, Map.robot), (Effort, RobotOptions)],
)
def test_python_takes_the_words_of_the_command_line(options, function):
    taken = inspect.signature(function).parameters
    in_numbers = {"memory": "memory_bytes"}
    for one in dataclasses.fields(options):
        assert in_numbers.get(one.name, one.name) in taken


def test_what_a_function_takes_reaches_it_unchanged():
    @keywords(old="new")
    def told(first: int, *, new: int = 0) -> tuple[int, int]:
        """What it was given."""
        return first, new

    assert (told(1), told(1, new=2), told(first=3)) == ((1, 0), (1, 2), (3, 0))
    assert told.__doc__ == "What it was given."
