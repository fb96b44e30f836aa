"""The search for the best order: honest about what judged it, what it took, and what is built."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from engram.errors import ConfigError, MapError
from engram.fleet.build import building, orders
from engram.fleet.build.building import find_best_order
from engram.fleet.build.orders import Orders
from engram.maps.map_files import copy_map
from engram.monitor import QUIET
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive

from .builds import KilledError, build, in_this_process, judge, killed
from .robots import OPTIONS


@pytest.fixture(autouse=True)
def one_process(monkeypatch):
    monkeypatch.setattr(building, "run_in_processes", in_this_process)


@pytest.fixture(scope="module")
def maps(tmp_path_factory, logs):
    """The maps of three groups of a drive each."""
    folder = tmp_path_factory.mktemp("groups")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "run_in_processes", in_this_process)
        build(folder / "centre.engram", logs, groups=3, keep=True)
    return [folder / "centre.engram.build" / f"group-{number}.engram" for number in range(3)]


@pytest.fixture(scope="module")
def searched(tmp_path_factory, maps, logs):
    """The orders of the first two of them, tried without any trouble."""
    folder = tmp_path_factory.mktemp("searched")
    return folder, search(folder, maps[:2], judge(logs["held-out"]))


def search(folder, maps, by, **changes):
    return find_best_order(maps, folder, Settings(), OPTIONS, by, QUIET, **changes)


def never(*_: object) -> None:
    pytest.fail("this order was judged already")


def test_a_search_that_is_done_is_not_done_again_and_says_what_it_took(
    tmp_path, maps, logs, searched
):
    shutil.copytree(searched[0], tmp_path, dirs_exist_ok=True)
    again = search(tmp_path, maps[:2], judge(logs["held-out"], localise=never))
    assert again.to_dict() == searched[1].to_dict()
    assert (again.spent.merges, again.spent.copies) == (2, 4)
    assert min(again.spent.merge_s, again.spent.copy_s, again.spent.judge_s) > 0


@pytest.mark.parametrize("what", ["drives", "distance", "localising", "reported", "groups"])
def test_verdicts_on_other_maps_or_by_other_judges_are_not_used(
    tmp_path, maps, logs, searched, monkeypatch, what
):
    by, groups = judge(logs["held-out"]), maps[:2]
    others = {
        "drives": (groups, judge(logs["other"])),
        "distance": (groups, replace(by, judge_at_m=4.0)),
        "localising": (groups, replace(by, localising=RobotOptions())),
        "reported": (groups, replace(by, reported=[logs["other"]])),
        "groups": ([maps[0], maps[2]], by),
    }
    shutil.copytree(searched[0], tmp_path, dirs_exist_ok=True)
    monkeypatch.setattr(building, "merge", killed)
    search(tmp_path, groups, by)
    with pytest.raises(KilledError):
        search(tmp_path, *others[what])


def test_a_search_that_was_killed_counts_what_it_had_done(tmp_path, maps, logs, searched):
    calls = 0

    def dies_over_the_second(*arguments):
        nonlocal calls
        calls += 1
        return killed() if calls == 2 else building.measure(*arguments)

    with pytest.raises(KilledError):
        search(tmp_path, maps[:2], judge(logs["held-out"], localise=dies_over_the_second))
    (tmp_path / "order-0-1.engram").touch()  # a real kill leaves the map that it was at
    again = search(tmp_path, maps[:2], judge(logs["held-out"]))
    assert (again.spent.merges, again.spent.copies) == (2, 4)
    assert again.results == searched[1].results
    assert not list(tmp_path.glob("*.engram*"))


@pytest.mark.parametrize("lost", ["all", "half", "spent", "result", "a figure"])
def test_a_step_that_cannot_be_read_is_made_again(tmp_path, maps, logs, searched, lost):
    shutil.copytree(searched[0], tmp_path, dirs_exist_ok=True)
    path = tmp_path / "order-1-0.json"
    content = path.read_text()
    values = json.loads(content)
    left = {
        "all": "",
        "half": content[: len(content) // 2],
        "spent": json.dumps(values | {"spent": {"coffee": 1}}),
        "result": json.dumps(values | {"result": None}),
        "a figure": json.dumps(values | {"result": {"order": [1, 0]}}),
    }
    path.write_text(left[lost])
    again = search(tmp_path, maps[:2], judge(logs["held-out"]))
    assert again.results == searched[1].results
    assert json.loads(path.read_text())["result"] == values["result"]


def test_each_group_comes_first_once_and_the_others_follow_in_their_order(
    tmp_path, maps, logs, monkeypatch
):
    monkeypatch.setattr(orders, "_MOST_GROUPS", 2)  # which is of all orders
    by = judge(logs["held-out"], orders=Orders.FIRST)
    found = search(tmp_path, maps, by)
    assert {one.order for one in found.results} == {(0, 1, 2), (1, 0, 2), (2, 0, 1)}
    assert found.order == min(found.results, key=lambda one: one.rank).order
    assert (found.spent.merges, found.spent.copies) == (3 * 2, 3 * 3)


def test_what_a_search_of_firsts_judged_all_orders_need_not_judge_again(
    tmp_path, maps, logs, searched
):
    shutil.copytree(searched[0], tmp_path, dirs_exist_ok=True)
    by = judge(logs["held-out"], localise=never, orders=Orders.FIRST)
    assert search(tmp_path, maps[:2], by).results == searched[1].results


@pytest.mark.long
def test_a_build_that_began_with_the_best_first_goes_on_as_such(tmp_path, logs, monkeypatch):
    centre, by = tmp_path / "centre.engram", judge(logs["held-out"], orders=Orders.FIRST)
    merge = building.merge
    monkeypatch.setattr(building, "merge", killed)
    with pytest.raises(KilledError):
        build(centre, logs, "ab", judge=by)
    monkeypatch.setattr(building, "merge", merge)
    with pytest.raises(ConfigError, match="which other options found"):
        build(centre, logs, "ab", judge=judge(logs["held-out"]))
    report = build(centre, logs, "ab", judge=by)
    assert report.best.tried is Orders.FIRST
    assert report.content_hash == report.best.results[0].content_hash
    assert "model (8)" not in report.text()


def test_a_drive_that_is_not_held_out_judges_nothing(tmp_path, maps, logs):
    with pytest.raises(
        ConfigError, match=r"a\.framelog is given to --validate.* is in .*group-0\.engram"
    ):
        search(tmp_path, maps[:2], judge(logs["a"]))
    with pytest.raises(ConfigError, match=r"held-out\.framelog .* the same drive"):
        search(tmp_path, maps[:2], judge(logs["held-out"], reported=[logs["held-out"]]))
    centre = tmp_path / "centre.engram"
    with pytest.raises(ConfigError, match=r"b\.framelog is given to --validate.* of this build"):
        build(centre, logs, "ab", judge=judge(logs["b"]))
    copy_map(maps[2], centre)
    with pytest.raises(
        ConfigError, match=r"c\.framelog is given to --validate.* in .*centre\.engram already"
    ):
        build(centre, logs, "ab", judge=judge(logs["c"]))
    assert not centre.with_name("centre.engram.build").exists()


def test_the_name_of_the_robot_does_not_let_a_drive_judge(tmp_path, maps, logs):
    robot, renamed = tmp_path / "robot.engram", open_drive(logs["held-out"], robot="somebody")
    map_drive(robot, renamed, Settings(), RobotOptions(relocaliser="exhaustive"))
    with pytest.raises(
        ConfigError, match=r"held-out\.framelog is given to --validate.* of somebody"
    ):
        search(tmp_path, [maps[0], robot], judge(logs["held-out"]))


def test_more_groups_than_can_be_tried_are_refused_before_they_are_mapped(
    tmp_path, logs, monkeypatch
):
    monkeypatch.setattr(orders, "_MOST_GROUPS", 2)
    centre = tmp_path / "centre.engram"
    with pytest.raises(ConfigError, match="3 groups have 6 orders; at most 2"):
        build(centre, logs, "abc", groups=3, judge=judge(logs["held-out"]))
    assert not centre.with_name("centre.engram.build").exists()


def test_orders_are_judged_with_the_centre_that_they_are_merged_into(tmp_path, maps, logs):
    centre = tmp_path / "centre.engram"
    copy_map(maps[2], centre)
    report = build(centre, logs, "ab", judge=judge(logs["held-out"]))
    assert (report.best.spent.merges, report.best.spent.copies) == (4, 4)
    assert report.content_hash == report.best.results[0].content_hash
    assert report.notes == []
    assert "apply to new fleet maps only" in report.text()


def test_a_centre_that_is_written_to_while_orders_are_tried_is_told(
    tmp_path, maps, logs, monkeypatch
):
    centre = tmp_path / "centre.engram"
    copy_map(maps[2], centre)

    def meanwhile(*arguments):
        found = building.measure(*arguments)
        building.merge(centre, [maps[1]], OPTIONS)
        return found

    with pytest.raises(MapError, match="changed while orders of merging were tried"):
        search(
            tmp_path / "orders", [maps[0]], judge(logs["held-out"], localise=meanwhile), root=centre
        )


@pytest.mark.long
def test_an_order_is_settled_before_the_first_merge(tmp_path, logs, monkeypatch):
    centre = tmp_path / "centre.engram"
    with monkeypatch.context() as patch:
        patch.setattr(building, "merge", killed)
        with pytest.raises(KilledError):
            build(centre, logs, "ab", judge=judge(logs["held-out"]))
    for other in (None, judge(logs["other"])):
        with pytest.raises(ConfigError, match="being merged already, in the order"):
            build(centre, logs, "ab", judge=other)
    monkeypatch.setattr(building, "measure", never)
    report = build(centre, logs, "ab", judge=judge(logs["held-out"]), keep=True)
    assert report.best.spent.judge_s > 0
    assert report.content_hash == report.best.results[0].content_hash
    assert report.notes == []
    # Other drives choose anew where there is no centre yet; the groups' maps are used again.
    monkeypatch.undo()
    centre.unlink()
    monkeypatch.setattr(
        building, "run_in_processes", lambda _, tasks, *rest: killed() if tasks else None
    )
    other = build(centre, logs, "ab", judge=judge(logs["other"]))
    assert other.best.results != report.best.results


def test_a_map_that_is_not_the_one_that_was_judged_is_told(tmp_path, maps, logs, monkeypatch):
    centre = tmp_path / "centre.engram"
    with monkeypatch.context() as patch:
        patch.setattr(building, "copy_map", lambda source, target: copied(source, target, centre))
        with pytest.raises(KilledError):
            build(centre, logs, "ab", judge=judge(logs["held-out"]))
    copied_really(maps[2], centre)
    report = build(centre, logs, "ab", judge=judge(logs["held-out"]))
    assert "is not the map that was judged" in report.notes[0]
    assert report.notes[0] in report.text()


copied_really = copy_map


def copied(source: Path, target: Path, centre: Path) -> None:
    """Dies before the centre is made."""
    if target == centre:
        raise KilledError
    copied_really(source, target)
