"""The history of a map as its users see it: log, show, diff, tag, revert."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from engram.maps.map import Map
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive


@pytest.fixture
def town(two_drives: Path, tmp_path: Path) -> Path:
    return shutil.copy(two_drives, tmp_path / "town.engram")


@pytest.fixture(scope="module")
def two_drives(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two revisions: the street, driven by two robots."""
    path = tmp_path_factory.mktemp("maps") / "town.engram"
    for robot in ("r1", "r2"):
        sequence = open_drive(
            street, robot=robot, recorded_at="2026-03-01T09:30:00", longitude_deg=0.0
        )
        map_drive(path, sequence, Settings(), RobotOptions())
    return path


def test_log_tells_who_when_what_and_tags(engram, town: Path) -> None:
    assert engram("tag", town, "first", 1, "-m", "before r2").status == 0
    newest, oldest = engram("log", town, "--json").json
    assert (newest["number"], oldest["number"]) == (2, 1)
    assert (newest["author"], oldest["author"]) == ("r2", "r1")
    assert (newest["tags"], oldest["tags"]) == ([], ["first"])
    assert oldest["contents"]["nodes"] > 0
    text = engram("log", town).out
    assert "revision 1 (tag: first)" in text
    assert "Author: r1 on" in text
    assert f"{oldest['contents']['nodes']} nodes" in text
    assert len(engram("log", town, "--oneline", "--at", 1).out.splitlines()) == 1


def test_every_reading_verb_takes_a_tag(engram, town: Path, street: Path) -> None:
    engram("tag", town, "first", 1)
    assert engram("info", town, "--at", "first", "--json").json["revision"] == 1
    found = engram("localise", town, street, "--at", "first", "--json").json
    assert found["summary"]["share_localised"] == 1.0
    assert len(engram("log", town, "--at", "first", "--json").json) == 1
    for verb in ("places", "relocalise"):
        arguments = (street,) if verb == "relocalise" else ()
        assert engram("lab", verb, town, *arguments, "--at", "head~1", "--json").status == 0


def test_show_and_diff_tell_the_same_change(engram, town: Path, tmp_path: Path) -> None:
    shown = engram("show", town, 1, "--json").json
    assert (shown["number"], shown["author"]) == (1, "r1")
    changed = engram("diff", town, 0, 1, "--json").json
    assert shown["difference"] == changed
    assert len(changed["sessions"]["added"]) == 1
    nodes = changed["nodes"]["added"]
    assert changed["hours"] == {"added": {"09": nodes}, "removed": {}}
    assert sum(region["added"] for region in changed["regions"]) == nodes
    assert [region["from_m"] for region in changed["regions"]] == [0.0]
    assert changed["mapped_m"]["after"] == pytest.approx(8.8, rel=0.1)  # 11 steps of 0.8 m
    picture = tmp_path / "change.png"
    text = engram("diff", town, 0, "head", "--picture", picture).out
    assert "09 h +" in text
    assert picture.stat().st_size > 1000


def test_revert_and_its_undoing(engram, town: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = engram("info", town, "--json").json
    dry = engram("revert", town, 1, "--dry-run", "--json").json
    assert dry["revision"] is None
    assert engram("info", town, "--json").json == before
    monkeypatch.setenv("ENGRAM_AUTHOR", "me")
    done = engram("revert", town, 1, "-m", "loose camera", "--json").json
    assert (done["reverted"], done["revision"]) == (1, 3)
    assert engram("log", town, "--json").json[0]["author"] == "me"
    assert (
        done["difference"]["nodes"]["after"]
        == before["nodes"] - (dry["difference"]["nodes"]["removed"])
    )
    assert done["lost_by_others"] == dry["lost_by_others"]
    text = engram("revert", town, 3).out
    assert "reverted by 4" in text
    assert text.splitlines()[-1] == f"to undo: engram revert {town} 4"
    after = engram("info", town, "--json").json
    assert after["nodes"] == before["nodes"]
    assert after["components"] == before["components"]
    assert engram("check", town).status == 0
    assert engram("log", town, "--json").json[1]["message"] == "revert revision 1: loose camera"


def test_show_of_a_node_names_robot_session_and_revision(engram, town: Path) -> None:
    session = engram("show", town, 1, "--json").json["difference"]["sessions"]["added"][0]
    with Map.open(town) as store:
        node = store.load().nodes[0]
    found = engram("show", town, str(node.id)[:10], "--json").json
    assert (found["robot"], found["session"]) == ("r1", session["session"])
    assert (found["revision"], found["visible"], found["told"]) == (1, True, [])
    assert found["hour"] == pytest.approx(9.5, abs=0.01)
    engram("revert", town, 1)
    text = engram("show", town, node.id).out
    assert "saved by r1" in text
    assert "hidden by revision 3" in text


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("show", "TOWN", 9), "revisions 1 to 2, not 9"),
        (("show", "TOWN", "spring"), "its tags: first"),
        (("diff", "TOWN", "first", "later"), "'later'"),
        (("diff", "TOWN", 1, 2, "--picture", "no/folder/a.png"), "no/folder"),
        (("tag", "TOWN", "7up"), "cannot be a tag"),
        (("tag", "TOWN", "first", 2), "already"),
        (("tag", "TOWN", "other", 5), "not 5"),
        (("tag", "TOWN", "other", 0), "revisions 1 to 2; 0 is before the first"),
        (("tag", "TOWN", "other", "--delete"), "no tag 'other'"),
        (("tag", "TOWN", "--delete"), "--delete needs the NAME of a tag"),
        (("tag", "TOWN", "--move"), "--move needs the NAME of a tag"),
        (("tag", "TOWN", "-m", "why"), "--message needs the NAME of a tag"),
        (("revert", "TOWN", 0), "no revision 0"),
        (("revert", "TOWN", "11"), "not 11"),
        (("show", "TOWN", "zz"), "'zz'"),
        (("show", "TOWN", "00000000"), "begins with"),
        (("info", "TOWN", "--at", "head~9"), "not -7"),
        (("log", "absent.engram"), "absent.engram"),
        (("revert", "absent.engram", 1), "absent.engram"),
        (("tag", "absent.engram", "x"), "absent.engram"),
    ],
)
def test_mistakes_end_in_one_clear_line(engram, town: Path, arguments, says: str) -> None:
    engram("tag", town, "first", 1)
    ran = engram(*(town if one == "TOWN" else one for one in arguments))
    assert ran.status == 2
    assert ran.err.startswith("engram: ")
    assert says in ran.err
    assert "Traceback" not in ran.err


def test_a_session_can_be_amended_and_the_map_is_listed_so(engram, town: Path) -> None:
    first, other = engram("info", town, "--sessions", "--json").json["session_list"]
    when = "2026-05-01T12:00:00Z"
    done = engram(
        "amend", town, first["session"][:8], "--robot", "van", "--recorded-at", when, "--json"
    ).json
    assert (done["robot"], done["revision"]) == ("van", 3)
    now, same = engram("info", town, "--sessions", "--json").json["session_list"]
    assert same == other
    assert (now["robot"], now["amended"]) == ("van", ["robot", "start"])
    assert now["start"].startswith("2026-05-01T12:00:00")
    assert (now["hour"], first["hour"]) == (12.0, 9.5)
    assert engram("amend", town, first["session"]).status == 2
    assert engram("amend", town, first["session"], "--robot", "van").status != 0
    assert engram("revert", town, 3).status == 0
    assert engram("info", town, "--sessions", "--json").json["session_list"] == [first, other]


def test_nodes_are_listed_with_their_drives(engram, town: Path) -> None:
    found = engram("info", town, "--nodes", "--json").json
    assert len(found["node_list"]) == found["nodes"]
    assert {one["robot"] for one in found["node_list"]} <= {"r1", "r2"}


def test_forgetting_is_previewed_then_done_undone_and_erased(engram, town: Path) -> None:
    asked = ("forget", town, "--session", engram("info", town, "--sessions", "--json").json[
        "session_list"
    ][0]["session"][:8])  # fmt: skip
    before = engram("check", town, "--json").json["rows"]
    preview = engram(*asked)
    assert "would go: 1 session" in preview.out
    assert "previewed only: --yes does it" in preview.out
    assert engram("log", town, "--json").json[0]["number"] == 2
    done = engram(*asked, "--yes", "--message", "asked by the owner")
    assert "forgotten by revision 3: 1 session" in done.out
    assert engram("log", town, "--json").json[0]["message"] == "forget: asked by the owner"
    assert done.out.splitlines()[-1] == f"to undo: engram revert {town} 3"
    assert engram("revert", town, 3).status == 0
    old = ("forget", town, "--older-than", "99999d", "--yes")
    assert engram(*old).out.splitlines() == ["nothing to forget"]
    assert engram(*asked, "--yes", "--json").json["forgotten"]["revision"] == 5
    assert "would be erased: " in engram("forget", town, "--erase").out
    erased = engram(*old, "--erase", "--json").json  # as a job that runs every night
    assert erased["forgotten"] is None
    assert erased["erased"]["rows"]["sessions"] == 1
    assert erased["erased"]["after_bytes"] < erased["erased"]["before_bytes"]
    refused = engram("revert", town, 5)
    assert (refused.status, "since been erased" in refused.err) == (2, True)
    assert engram("check", town).status == 0
    assert engram("check", town, "--json").json["rows"] > before
    assert engram("forget", town).status == 2
    assert "--region is" in engram("forget", town, "--region", "1,2").err
