"""`engram merge` and `engram build` as they are typed."""

from __future__ import annotations

import pytest

from engram.errors import MapCorruptError
from engram.fleet.merge.report import MergeReport


@pytest.fixture
def robot(engram, street, tmp_path):
    """A robot's map of the street."""
    path = tmp_path / "r1.engram"
    assert engram("map", path, street, "--robot", "r1").status == 0
    return path


def test_merge_hands_in_a_map_once(engram, robot, tmp_path):
    centre = tmp_path / "centre.engram"
    tried = engram("merge", centre, robot, "--dry-run", "--json").json["merges"][0]
    assert not centre.exists()
    assert (tried["changed"], tried["revision"]) == (True, None)
    done = engram("merge", centre, robot, "--json").json["merges"][0]
    assert done["revision"] == 1
    assert done["taken"] > 0
    assert done["content_hash"] == tried["content_hash"]
    again = engram("merge", centre, robot)
    assert again.status == 0
    assert "nothing new" in again.out
    engram("goal", "add", robot, "dock", "--x", 1, "--y", 0)
    assert "revision 2" in engram("merge", centre, robot).out
    assert "dock" in engram("goal", "list", centre).out
    assert engram("check", centre).status == 0


def test_merge_refuses_what_is_no_map(engram, robot, tmp_path):
    refused = engram("merge", robot, tmp_path / "nothing.engram", "--json")
    assert refused.status == 2
    assert refused.json["error"]["kind"] == "NotAMapError"


@pytest.fixture
def failing(monkeypatch):
    """The second map of every merge fails, with this error."""

    def fail(error):
        def merge(centre, robots, options, monitor, **_):
            monitor.hear(MergeReport(str(robots[0]), "", ["r1"], revision=2, changed=True, taken=3))
            raise error

        monkeypatch.setattr("engram.fleet.merge.merging.merge", merge)

    return fail


def test_merge_tells_what_stands_where_a_later_map_fails(engram, failing, tmp_path):
    failing(MapCorruptError("r2.engram is damaged"))
    asked = ("merge", tmp_path / "c.engram", "r1.engram", "r2.engram")
    ran = engram(*asked, "--json")
    assert ran.status == 2
    assert [one["revision"] for one in ran.json["merges"]] == [2]
    expected = {"kind": "MapCorruptError", "message": "r2.engram is damaged"}
    assert ran.json["error"] == expected
    ran = engram(*asked)
    assert ran.status == 2
    assert "revision 2" in ran.out
    assert "r2.engram is damaged" in ran.err


def test_merge_tells_what_stands_where_it_is_stopped_between_two_maps(engram, failing, tmp_path):
    failing(KeyboardInterrupt())
    ran = engram("merge", tmp_path / "c.engram", "r1.engram", "r2.engram", "--json")
    assert ran.status == 130
    assert [one["revision"] for one in ran.json["merges"]] == [2]
    assert "kept" in ran.json["error"]["message"]


def test_build_maps_and_merges(engram, street, tmp_path):
    town = tmp_path / "town.engram"
    built = engram("build", town, street, "--groups", 1, "--workers", 1, "--json")
    assert built.status == 0
    assert built.json["groups"] == [["street"]]
    assert built.json["mapped"][0]["sessions"][0]["nodes_saved"] > 0
    refused = engram("build", town, street, "--groups", 3)
    assert refused.status == 2
    assert "must be 1 to 1" in refused.err


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        (("--validate", "held-out.framelog"), "--validate compares orders of merging"),
        (("--grouping", "random:x"), "must be a whole number"),
        (("--order", "best"), "name some"),
        (("--order", "best-first"), "name some"),
        (("--order", "worst", "--validate", "held-out.framelog"), "known: best, best-first"),
        (("--set", "build.max_gap_m=-1"), "max_gap_m"),
        (("--set", "merge.rounds=0"), "rounds"),
    ],
)
def test_build_refuses_options_that_mean_nothing(engram, street, tmp_path, asked, says):
    refused = engram("build", tmp_path / "town.engram", street, "--groups", 1, *asked)
    assert refused.status == 2
    assert says in refused.err
    assert list(tmp_path.iterdir()) == []
