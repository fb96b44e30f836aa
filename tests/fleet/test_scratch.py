"""A build that is killed anywhere goes on, and never loses a drive."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

import pytest

from engram.errors import ConfigError, InputError, MapError, MapLockedError, StorageFullError
from engram.fleet.build import building
from engram.fleet.build.building import find_best_order
from engram.fleet.build.scratch import BuildPlan, Scratch, build_folder, sessions_of
from engram.maps.map_files import copy_map
from engram.robot.localisers import session_of_drive
from engram.robot.mapping import map_drive
from engram.robot.settings import Settings
from engram.sequences.opening import open_drive

from .builds import KilledError, build, in_this_process, judge, killed, options
from .robots import OPTIONS


@pytest.fixture(autouse=True)
def one_process(monkeypatch):
    monkeypatch.setattr(building, "run_in_processes", in_this_process)


@pytest.fixture(scope="module")
def kept(tmp_path_factory, logs):
    """A centre of two groups, (a) and (b), whose maps were kept."""
    centre = tmp_path_factory.mktemp("kept") / "centre.engram"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "run_in_processes", in_this_process)
        report = build(centre, logs, "ab", keep=True)
    return centre, report


@pytest.fixture
def begun(tmp_path, kept):
    """The same, free to be changed."""
    centre = tmp_path / "centre.engram"
    shutil.copytree(build_folder(kept[0]), build_folder(centre))
    copy_map(kept[0], centre)
    return centre


def unfinished(centre: Path) -> None:
    """As if the build had been killed before it was complete."""
    path = build_folder(centre) / "build.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"complete": False}))


def map_one(centre: Path, log: str) -> None:
    map_drive(centre, open_drive(Path(log)), Settings(), options().mapping)


def session(log: str) -> str:
    return str(session_of_drive(open_drive(Path(log))).id)


def test_a_centre_that_came_meanwhile_takes_in_the_first_group_too(begun, logs):
    unfinished(begun)
    begun.unlink()
    map_one(begun, logs["c"])
    report = build(begun, logs, "ab")
    assert sessions_of(begun) == {session(logs[name]) for name in "abc"}
    assert len(report.merges) == 2
    assert not build_folder(begun).exists()


def test_a_build_killed_after_the_first_copy_comes_to_the_same_map(
    tmp_path, logs, kept, monkeypatch
):
    centre = tmp_path / "centre.engram"
    with monkeypatch.context() as patch:
        patch.setattr(building, "merge", killed)
        with pytest.raises(KilledError):
            build(centre, logs, "ab")
    assert sessions_of(centre) == {session(logs["a"])}
    report = build(centre, logs, "ab")
    assert [one.changed for one in report.merges] == [False, True]
    assert report.content_hash == kept[1].content_hash
    assert report.text().startswith(kept[1].text().split(" nodes")[0])


def test_a_build_killed_between_two_merges_counts_the_time_of_both(begun, logs, kept, monkeypatch):
    unfinished(begun)
    begun.unlink()
    with monkeypatch.context() as patch:
        patch.setattr(Scratch, "finish", killed)
        with pytest.raises(KilledError):
            build(begun, logs, "ab")
    report = build(begun, logs, "ab")
    assert not any(one.changed for one in report.merges)
    assert report.merged_before_s > 0
    assert report.parallel_s > report.merged_before_s
    assert report.content_hash == kept[1].content_hash


def test_a_build_killed_while_it_clears_up_is_cleared_by_the_next(begun, logs, monkeypatch):
    unfinished(begun)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", killed)
        (build_folder(begun) / "orders").mkdir()
        with pytest.raises(KilledError):
            build(begun, logs, "ab")
    assert build_folder(begun).exists()
    assert "nothing new" in build(begun, logs, "ab").text()
    assert not build_folder(begun).exists()


def test_the_groups_maps_stay_where_the_centre_lacks_one_of_them(begun, logs, monkeypatch):
    unfinished(begun)
    begun.unlink()
    map_one(begun, logs["c"])
    monkeypatch.setattr(building, "_merge", lambda *_: None)  # whatever might go wrong in it
    with pytest.raises(MapError, match="no longer contains sessions"):
        build(begun, logs, "ab")
    assert (build_folder(begun) / "group-0.engram").exists()


def test_a_build_that_is_complete_does_not_block_the_next(begun, logs):
    report = build(begun, logs, "abc", groups=1)
    assert report.left_out == ["a.framelog", "b.framelog"]
    assert report.groups == [["c.framelog"]]
    assert len(sessions_of(begun)) == 3
    assert not build_folder(begun).exists()


def test_maps_that_were_kept_are_used_again_and_stay_while_nothing_is_new(begun, logs, kept):
    assert "nothing new" in build(begun, logs, "ab").text()
    begun.unlink()
    made = (build_folder(begun) / "group-0.engram").stat().st_mtime_ns
    report = build(begun, logs, "ab", keep=True)
    assert report.content_hash == kept[1].content_hash
    assert (build_folder(begun) / "group-0.engram").stat().st_mtime_ns == made


def test_maps_that_were_kept_and_are_nowhere_else_are_not_removed(begun, logs):
    begun.unlink()
    with pytest.raises(ConfigError, match=r"2 of their sessions are missing .* move the folder"):
        build(begun, logs, "c", groups=1)
    assert (build_folder(begun) / "group-0.engram").exists()


def test_a_build_that_left_drives_out_wants_the_centre_that_has_them(begun, logs, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(building, "merge", killed)
        with pytest.raises(KilledError):
            build(begun, logs, "abc", groups=1)
    begun.unlink()
    with pytest.raises(ConfigError, match="no longer has 2 of the 2 sessions"):
        build(begun, logs, "abc", groups=1)


def test_a_folder_without_a_plan_is_not_taken_for_a_build(tmp_path):
    centre = tmp_path / "centre.engram"
    plan = BuildPlan([["a"]], [], "", {}, {})
    build_folder(centre).mkdir()
    (build_folder(centre) / "build.json.part").touch()  # killed in its first moment
    Scratch(centre).begin(plan)
    (build_folder(centre) / "build.json").unlink()
    (build_folder(centre) / "group-0.engram").touch()
    with pytest.raises(ConfigError, match=r"group-0\.engram, but no plan"):
        Scratch(centre).begin(plan)
    (build_folder(centre) / "build.json").write_text("[")
    with pytest.raises(ConfigError, match=r"build\.json cannot be read"):
        Scratch(centre)


def test_a_folder_that_is_not_there_is_not_made(tmp_path, logs):
    (tmp_path / "afile").touch()
    for folder in ("nowhere", "afile"):
        with pytest.raises(InputError, match=rf"{folder} is not a folder; make it first"):
            build(tmp_path / folder / "centre.engram", logs, "a", groups=1)
    assert [one.name for one in tmp_path.iterdir()] == ["afile"]


def test_of_two_builds_into_one_centre_the_second_is_told_who_builds(tmp_path, logs, monkeypatch):
    centre = tmp_path / "centre.engram"
    refused = []

    def meanwhile(*arguments):
        monkeypatch.setattr(building, "run_in_processes", in_this_process)
        with pytest.raises(MapLockedError) as raised:
            build(centre, logs, "a", groups=1)
        refused.append(str(raised.value))
        in_this_process(*arguments)

    monkeypatch.setattr(building, "run_in_processes", meanwhile)
    build(centre, logs, "a", groups=1)
    assert f"centre.engram is being built by process {os.getpid()} on " in refused[0]
    assert "nothing new" in build(centre, logs, "a", groups=1).text()


def test_a_file_where_the_builds_folder_should_be_is_named_and_stays(tmp_path, logs):
    centre = tmp_path / "centre.engram"
    build_folder(centre).write_text("mine")
    with pytest.raises(MapError, match=r"centre\.engram\.build: Not a directory; a build keeps"):
        build(centre, logs, "a", groups=1)
    assert build_folder(centre).read_text() == "mine"
    with pytest.raises(MapError, match="Not a directory"):
        find_best_order(
            [Path(logs["a"])],
            build_folder(centre) / "orders",
            Settings(),
            OPTIONS,
            judge(logs["held-out"]),
            None,
        )


@pytest.mark.parametrize(
    ("number", "kind"), [(errno.ENOSPC, StorageFullError), (errno.EROFS, MapError)]
)
def test_what_the_disk_refuses_is_an_error_of_maps(tmp_path, monkeypatch, number, kind):
    def refuse(path, *_, **__):
        raise OSError(number, "refused", str(path))

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with pytest.raises(kind, match=r"build\.json\.\d+\.part: (no space|refused)") as raised:
        Scratch(tmp_path / "centre.engram").begin(BuildPlan([["a"]], [], "", {}, {}))
    assert type(raised.value) is kind
