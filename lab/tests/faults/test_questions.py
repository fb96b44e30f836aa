"""Questions of the faults study: what is counted, and what is kept."""

from __future__ import annotations

import json

import numpy as np
import pytest
from lab.tests.evaluation.campaigns import write_campaign
from typer.testing import CliRunner

from engram.geometry.se3 import SE3
from engram.robot.settings import Settings
from engram_lab.accuracy import Count, Fix, events
from engram_lab.cli import lab
from engram_lab.studies.faults import questions, table
from engram_lab.studies.faults.fleets import MOUNTED, MountedSequence
from engram_lab.studies.streets import (
    Kind,
    Street,
    Try,
    campaign_of,
    longer_trial_town,
    map_path,
    mapping_settings,
    trial_town,
)
from engram_lab.town.session import SimulatedSequence


def along(*metres: float) -> list[SE3]:
    return [SE3(np.eye(3), np.array([0.0, 0.0, at])) for at in metres]


@pytest.mark.parametrize(
    ("at_m", "count"),
    [((), 0), ((5.0,), 1), ((5.0, 24.0, 43.0), 1), ((5.0, 25.5), 2), ((0.0, 1.0, 90.0, 91.0), 2)],
)
def test_false_fixes_less_than_20_m_apart_are_one_event(at_m, count) -> None:
    assert events(along(*at_m)) == count


def test_a_robot_is_counted_and_counts_add_up() -> None:
    fixes = [Fix(0, 0.1, False), Fix(2, 5.0, True, 8.0), Fix(3, 0.6, False)]
    one = Count.of(fixes, along(0, 1, 2, 3), after=1)
    assert (one.frames, one.metres, one.fixes, one.right) == (4, 3.0, 3, 2)
    assert (one.off, one.false, one.sure, one.hurt, one.events) == (2, 1, 1, 1, 1)
    assert (one.worst_m, one.again) == (5.0, (2,))
    never = Count.of(fixes[:1], along(0, 1), after=1)
    both = one + never
    assert (both.robots, both.frames, both.worst_m, both.again) == (2, 6, 5.0, (2,))


def test_without_an_event_the_bound_is_three_over_the_distance() -> None:
    """−ln 0.05 = 2.996: the textbook's rule of three."""
    bound = {one.name: one.value for one in table.figures_of("a", Count(robots=2, metres=100e3))}[
        "  their upper bound, 95 %"
    ]
    assert bound == pytest.approx(2.9957, abs=1e-3)


def test_paired_shares_have_an_interval_over_the_drives() -> None:
    found = {one.name: one.value for one in table.paired("a", [0.10, 0.06], [0.04, 0.02])}
    assert found["a: missed"] == pytest.approx(8.0)
    assert found["  more"] == pytest.approx(-5.0)
    assert (found["  from"], found["  to"]) == (pytest.approx(-6.0), pytest.approx(-4.0))


def test_what_a_table_holds_is_not_made_again_after_a_kill(tmp_path) -> None:
    asked = table.Asked(Settings(), tmp_path)
    made = Count(robots=1, false=2, again=(3,))
    table.Table("hints", asked).add("cold", "a", lambda: made)
    (file,) = tmp_path.iterdir()
    file.write_text(file.read_text() + '{"key": "cold: b", "cou')
    again = table.Table("hints", asked)
    assert again.add("cold", "a", lambda: 1 / 0) == made
    again.add("cold", "b", lambda: made)
    values = {one.name: one.value for one in again.figures()}
    assert values["cold: robots"] == values["all: robots"] == 2
    assert values["  false"] == 4


def test_maps_are_of_distinct_drives_and_drawn_again_alike() -> None:
    drawn = questions.drawn_maps(10, 6)
    assert drawn == questions.drawn_maps(10, 6)
    assert all(len(set(one)) == 3 and list(one) == sorted(one) for one in drawn)
    assert len(set(drawn)) == len(drawn)


def test_settings_of_localising_change_no_map_and_others_do() -> None:
    town, usual = trial_town(401), Settings()
    lost = usual.localiser.__class__(search_radius_m=9.0)
    robots = Settings(localiser=lost)
    assert map_path(town, [0], robots) == map_path(town, [0], usual)
    assert mapping_settings(robots) == usual
    mapper = usual.mapper.__class__(sure_inliers=0)
    assert map_path(town, [0], Settings(mapper=mapper)) != map_path(town, [0], usual)


def test_a_longer_trial_town_begins_with_the_shorter_one() -> None:
    short, longer = trial_town(401), longer_trial_town(401)
    assert longer.sessions[: len(short.sessions)] == short.sessions
    assert [one.number for one in longer.sessions] == list(range(15))
    assert len({one.seed for one in longer.sessions}) == 15
    assert [one.reverse for one in longer.sessions] == [False] * 12 + [True] * 3
    assert campaign_of("401") == longer
    assert campaign_of("oxford@2").seed == 2


def test_a_mounted_camera_stands_higher_and_aside_and_looks_down() -> None:
    town = longer_trial_town(401)
    usual, other = SimulatedSequence(town, 6), MountedSequence(town, 6, MOUNTED)
    for a, b in zip(usual.truth().world_from_cam, other.truth().world_from_cam, strict=True):
        np.testing.assert_allclose((a.inverse() @ b).matrix(), MOUNTED.matrix(), atol=1e-9)
    before, after = usual.drive.poses[9].world_from_cam, other.drive.poses[9].world_from_cam
    assert after.translation[2] - before.translation[2] == pytest.approx(0.5, abs=0.03)
    down = np.rad2deg(np.arcsin(before.matrix()[2, 2]) - np.arcsin(after.matrix()[2, 2]))
    assert down == pytest.approx(10.0, abs=0.1)
    assert other.camera.id != usual.camera.id


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory):
    """A road of 24 m: two drives of one look, and one of another."""
    return write_campaign(tmp_path_factory.mktemp("campaign"), [0, 0, 1]).drives


@pytest.mark.parametrize("live", [1, 2])
def test_a_known_look_is_found_when_switched_on_and_an_unknown_one_cannot_be(
    drives, live, tmp_path
) -> None:
    there = Street(tmp_path / "map.engram", drives[:1], drives[live], Settings())
    starts = questions.first_frames(there, 5)
    for first in starts:
        one = questions.switched_on(there, first)
        if live == 1:
            assert (one.fixes, one.false) == (1, 0)
        else:
            assert one.fixes == 0
            assert questions.could_be_found(there, first, one.frames).robots == 0
    assert questions.could_be_found(there, starts[0], 2).robots == (live == 1)
    undisturbed = there.count(Try(Kind.UNDISTURBED))
    assert (undisturbed.right > 0, undisturbed.false) == (live == 1, 0)
    there.close()


def test_the_study_lists_its_questions_and_asks_one(tmp_path, monkeypatch) -> None:
    def asks(asked: table.Asked):
        yield table.Figure(f"towns {asked.towns}", asked.settings.localiser.search_radius_m, "m")

    run = CliRunner().invoke
    wrong = run(lab, ["evaluate", "faults", "--only", "hint"])
    assert "hints" in str(wrong.exception)
    monkeypatch.setitem(questions.QUESTIONS, "hints", asks)
    given = ["evaluate", "faults", "--only", "hints", "--towns", "7,8", "--json"]
    given += ["--set", "localiser.search_radius_m=9", "--work", str(tmp_path)]
    answer = run(lab, given)
    assert json.loads(answer.stdout) == {
        "hints": [{"name": "towns (7, 8)", "value": 9.0, "unit": "m"}]
    }
