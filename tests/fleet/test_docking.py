"""Handing in: what is refused, what is reported, and that the centre is never half changed."""

from __future__ import annotations

import json
import random
import select
import shutil
import signal
import sqlite3
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from uuid import uuid4

import numpy as np
import pytest

from engram.errors import (
    ConfigError,
    IncompatibleError,
    InputError,
    MapCorruptError,
    MapError,
    NotAMapError,
    RefusedError,
    SequenceError,
)
from engram.fleet.merge import gate, merging
from engram.fleet.merge.gate import check_held_out, what_is_worse
from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.merging import merge
from engram.fleet.merge.report import MergeReport, Reason, RunReport, Seed, SegmentReport
from engram.geometry.se3 import SE3
from engram.graph.model import Clock, NodeId, Omission, SessionId
from engram.maps.map import Map
from engram.maps.map_files import check_file, copy_map
from engram.maps.writer import RevisionWriter
from engram.measures import Drive
from engram.monitor import QUIET, Monitor
from engram.robot.localisers import session_of_drive
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import measure
from engram.sequences.opening import open_drive
from engram_lab.teblid import TEBLID

from .robots import frame_log, merged, rewritten, robot_map

HOUR_NS = 3_600_000_000_000
WELL = Drive(np.ones(40), np.ones(40, np.bool_))
BADLY = Drive(np.ones(40), np.zeros(40, np.bool_))


@pytest.fixture
def centre(tmp_path, fleet):
    """A centre that has what `first` saw."""
    path = tmp_path / "centre.engram"
    merged(path, fleet["first"][0])
    return path


def hash_of(path: Path) -> str:
    with Map.open(path) as store:
        return store.content_hash()


def nodes_in(path: Path) -> int:
    with Map.open(path) as store:
        return store.info().nodes


def swapped(source: Path, target: Path, node: NodeId | None = None) -> tuple[Path, NodeId]:
    """A copy of a map in which a node has the landmarks of another; and its UUID."""
    with Map.open(source) as store:
        nodes = store.load().nodes
        node = node or nodes[3].id
        others = [one for one in nodes if one.id != node]
        other = next(iter(store.frames.stored(others[-1:])))

    def changed(stored):
        if stored.node.id != node:
            return stored
        return replace(stored, landmarks=other.landmarks, landmark_hash=other.landmark_hash)

    return rewritten(source, target, node=changed), node


def omitted_from(centre: Path, robot: Path) -> NodeId:
    """Merges a map, and names a node that was not taken."""
    merged(centre, robot)
    with Map.open(centre) as store:
        return next(iter(store.omissions))


def damaged(source: Path, target: Path) -> Path:
    """A copy of a map in which a bit of the last node's landmarks was lost."""
    shutil.copy(source, target)
    with Map.open(target) as store:
        stored = list(store.frames.stored(store.load().nodes))[-1]
    content = bytearray(target.read_bytes())
    at = content.find(stored.landmarks[300:400])
    assert at > 0
    content[at + 50] ^= 1
    target.write_bytes(bytes(content))
    return target


@pytest.fixture
def judged(monkeypatch):
    """Says how held-out drives localise: before, and after each merge."""

    def say(*found: Drive) -> None:
        answers = iter([[one] for one in found])
        named = SimpleNamespace(id=SessionId(uuid4()), camera="another", start_ns=0)
        monkeypatch.setattr(
            "engram.fleet.merge.gate.Gate._localise", lambda self, store, _: next(answers)
        )
        monkeypatch.setattr("engram.fleet.merge.gate.open_drive", lambda path: path)
        monkeypatch.setattr("engram.fleet.merge.gate.session_of_drive", lambda sequence: named)

    return say


class Told(Monitor):
    """Keeps the reports."""

    def __init__(self, reports: list) -> None:
        self.hear = reports.append


class TestRefused:
    def refuses(self, centre: Path, robot: Path, error: type[Exception], *words: str) -> None:
        before, content = hash_of(centre), centre.read_bytes()
        with pytest.raises(error) as raised:
            merged(centre, robot)
        assert all(word in str(raised.value) for word in words), raised.value
        assert centre.read_bytes() == content
        assert hash_of(centre) == before
        assert check_file(centre).problems == ()

    def test_maps_of_other_descriptors(self, tmp_path, centre, fleet):
        robot = rewritten(fleet["other"][0], tmp_path / "t.engram", descriptor=TEBLID)
        self.refuses(centre, robot, IncompatibleError, "teblid", "brief")

    def test_a_node_with_the_uuid_of_another(self, tmp_path, centre, fleet):
        robot, node = swapped(fleet["first"][0], tmp_path / "r.engram")
        self.refuses(centre, robot, IncompatibleError, str(node), "another in the fleet map")

    def test_a_node_that_was_omitted_and_comes_with_other_landmarks(self, tmp_path, centre, fleet):
        node = omitted_from(centre, fleet["same"][0])
        robot, _ = swapped(fleet["same"][0], tmp_path / "r.engram", node)
        self.refuses(centre, robot, IncompatibleError, str(node), "another in the fleet map")

    def test_an_omission_of_what_the_centre_has_with_other_landmarks(self, tmp_path, centre, fleet):
        """Another centre omitted a node under the UUID of one that this one took."""
        other, node = swapped(fleet["same"][0], tmp_path / "other.engram")
        theirs = tmp_path / "theirs.engram"
        merged(theirs, fleet["first"][0])
        with Map.open(theirs, writes=True) as store, Map.open(other) as given:
            known = store.load().nodes[0].id
            omission = Omission(node, known, SE3.identity(), given.landmark_hashes[node])
            with store.begin_revision(author="tests", message="", configuration={}) as writer:
                writer.add_omission(omission)
                writer.commit()
        shutil.copy(fleet["same"][0], centre)
        self.refuses(centre, theirs, IncompatibleError, str(node), "another in the fleet map")

    def test_maps_of_format_2_did_not_keep_what_they_omitted(self, tmp_path, centre, fleet):
        """Nothing can be said of such nodes, so nothing is refused."""
        node = omitted_from(centre, fleet["same"][0])
        with Map.open(centre) as store:
            assert store.omissions[node].landmark_hash is not None
        connection = sqlite3.connect(centre)
        with connection:
            connection.execute("DELETE FROM omitted_landmarks")
        connection.close()
        robot, _ = swapped(fleet["same"][0], tmp_path / "r.engram", node)
        (report,) = merged(centre, robot)
        assert not report.changed

    def test_what_a_revert_took_back_binds_nobody(self, tmp_path, centre, fleet):
        node = omitted_from(centre, fleet["same"][0])
        with Map.open(centre, writes=True) as store:
            store.revert("head", author="tests", message="")
            assert node not in store.landmark_hashes
        robot, _ = swapped(fleet["same"][0], tmp_path / "r.engram", node)
        merged(centre, robot)
        with Map.open(centre) as store, Map.open(robot) as given:
            assert store.landmark_hashes[node] == given.landmark_hashes[node]

    def test_a_drive_with_the_uuid_of_another(self, tmp_path, centre, fleet):
        robot = rewritten(
            fleet["first"][0], tmp_path / "r.engram", session=lambda one: replace(one, robot="x")
        )
        self.refuses(centre, robot, IncompatibleError, "session")

    @pytest.mark.parametrize("share", [0.3, 0.7, 0.97])
    def test_a_truncated_file(self, tmp_path, centre, fleet, share):
        robot = tmp_path / "cut.engram"
        content = fleet["longer"][0].read_bytes()
        robot.write_bytes(content[: int(len(content) * share)])
        self.refuses(centre, robot, MapError)

    def test_a_file_that_is_missing_or_no_map(self, tmp_path, centre):
        self.refuses(centre, tmp_path / "nothing.engram", NotAMapError, "no such file")
        robot = tmp_path / "text.engram"
        robot.write_text("hello")
        self.refuses(centre, robot, NotAMapError)

    def test_the_centre_itself(self, centre):
        self.refuses(centre, centre, InputError, "the fleet map itself")

    def test_landmarks_that_were_damaged_on_the_way(self, tmp_path, centre, fleet):
        robot = damaged(fleet["longer"][0], tmp_path / "damaged.engram")
        self.refuses(centre, robot, MapError, str(robot))

    def test_a_row_that_was_damaged_on_the_way(self, tmp_path, centre, fleet):
        robot = tmp_path / "damaged.engram"
        copy_map(fleet["longer"][0], robot)
        with sqlite3.connect(robot) as connection:
            connection.execute("UPDATE edges SET a_from_b = zeroblob(96) WHERE key = 2")
        connection.close()
        self.refuses(centre, robot, MapCorruptError, f"{robot}: table edges")


class TestNothingIsMade:
    """A centre that is new appears with its first merge, or not at all."""

    @pytest.fixture
    def new(self, tmp_path):
        folder = tmp_path / "centres"
        folder.mkdir()
        yield folder / "new.engram"
        assert list(folder.iterdir()) == []

    @pytest.mark.parametrize("share", [0.3, 0.97])
    def test_of_a_truncated_file(self, tmp_path, new, fleet, share):
        robot = tmp_path / "cut.engram"
        content = fleet["longer"][0].read_bytes()
        robot.write_bytes(content[: int(len(content) * share)])
        with pytest.raises(MapError):
            merged(new, robot)

    def test_of_damaged_landmarks(self, tmp_path, new, fleet):
        with pytest.raises(MapError):
            merged(new, damaged(fleet["longer"][0], tmp_path / "damaged.engram"))

    def test_where_a_held_out_drive_is_missing(self, tmp_path, new, fleet):
        with pytest.raises(SequenceError, match="nosuch"):
            merged(new, fleet["first"][0], require_better=[tmp_path / "nosuch.framelog"])

    def test_where_the_gate_refuses(self, tmp_path, new, fleet, judged):
        judged(WELL, BADLY)
        with pytest.raises(RefusedError):
            merged(new, fleet["first"][0], require_better=[tmp_path / "held-out"])

    @pytest.mark.parametrize("name", ["nowhere/x.png", "x.foo"])
    def test_where_the_picture_cannot_be_drawn(self, tmp_path, new, fleet, name):
        with pytest.raises(InputError, match="picture"):
            merged(new, fleet["first"][0], picture=tmp_path / name)

    def test_where_a_later_map_cannot_be_opened(self, tmp_path, new, fleet):
        robot = tmp_path / "text.engram"
        robot.write_text("hello")
        with pytest.raises(NotAMapError):
            merged(new, fleet["first"][0], robot)


class TestReported:
    def test_what_was_merged_before_a_later_map_failed(self, tmp_path, centre, fleet):
        bad = damaged(fleet["other"][0], tmp_path / "damaged.engram")
        told = []
        with pytest.raises(MapError):
            merged(centre, fleet["longer"][0], bad, monitor=Told(told))
        (report,) = told
        assert (report.source, report.revision) == (str(fleet["longer"][0]), 2)
        assert report.content_hash == hash_of(centre)

    def test_a_map_of_another_town_becomes_a_part_of_its_own(self, centre, fleet):
        (report,) = merged(centre, fleet["other"][0])
        assert report.omitted == 0
        assert any("none of its nodes matched" in note for note in report.notes)

    def test_another_town_is_told_even_where_its_drives_found_each_other(
        self, tmp_path, centre, fleet
    ):
        again, town = tmp_path / "again.engram", tmp_path / "town.engram"
        robot_map(again, np.arange(0, 24, 0.8), 1, name="r5", day=5)
        apart = MergeOptions(relocaliser="none")
        merge(town, [fleet["other"][0], again], apart)
        (report,) = merged(centre, town)
        assert report.omitted
        assert report.taken
        assert any("none of its nodes matched" in note for note in report.notes)

    def test_a_drive_of_which_a_part_was_not_found(self, tmp_path, centre, fleet):
        mixed = tmp_path / "mixed.engram"
        apart = MergeOptions(relocaliser="none")
        merge(mixed, [fleet["other"][0], fleet["longer"][0]], apart)
        (report,) = merged(centre, mixed)
        (note,) = [note for note in report.notes if "not connected to the existing map" in note]
        assert f": {nodes_in(fleet['other'][0])} added nodes;" in note

    def test_two_robots_of_one_name(self, tmp_path, fleet):
        maps = []
        for name in ("same", "other"):
            robot = tmp_path / f"{name}.engram"
            maps.append(
                rewritten(
                    fleet[name][0],
                    robot,
                    session=lambda one: replace(one, clock=Clock.UTC, robot="twin", start_ns=0),
                )
            )
        _, report = merged(tmp_path / "centre.engram", *maps)
        (note,) = [note for note in report.notes if "same name" in note]
        assert "'twin'" in note
        # Told when it came; handed in again it is no news.
        assert all(not one.notes for one in merged(tmp_path / "centre.engram", *maps))

    def test_a_clock_that_is_ahead_by_years(self, tmp_path, fleet):
        ahead = rewritten(
            fleet["other"][0],
            tmp_path / "ahead.engram",
            session=lambda one: replace(one, clock=Clock.UTC, start_ns=2**62),
        )
        (report,) = merged(tmp_path / "centre.engram", ahead)
        assert any("hours from now" in note for note in report.notes)

    def test_a_clock_that_runs_backwards(self, tmp_path, fleet):
        with Map.open(fleet["other"][0]) as store:
            nodes = store.load().nodes
        middle = nodes[len(nodes) // 2].stamp_ns

        def set_back(stored):
            if stored.node.stamp_ns < middle:
                return stored
            stamp_ns = stored.node.stamp_ns - HOUR_NS
            return replace(stored, node=replace(stored.node, stamp_ns=stamp_ns))

        robot = rewritten(fleet["other"][0], tmp_path / "back.engram", node=set_back)
        (report,) = merged(tmp_path / "centre.engram", robot)
        assert any("runs backwards" in note for note in report.notes)
        assert report.taken == len(nodes)
        assert check_file(tmp_path / "centre.engram").problems == ()

    def test_the_report_says_all_of_it_in_text_and_json(self, centre, fleet):
        (report,) = merged(centre, fleet["longer"][0])
        assert "nodes added" in report.text()
        assert "no similar place in the map" in report.text()
        values = report.to_dict()
        assert values["revision"] == 2
        (segment,) = values["segments"]
        assert segment["taken"] == values["taken"] == sum(run["nodes"] for run in segment["runs"])
        assert segment["runs"][-1]["reason"] == "no_place"

    def test_a_drive_in_many_segments_takes_one_line(self):
        run = RunReport(0, 1, 0.0, Reason.NOTHING_NEAR)
        segments = [
            SegmentReport("5621beba-1", "r1", stamp, Seed.NONE, 1, 0, [run]) for stamp in range(50)
        ]
        segments.append(SegmentReport("5621beba-1", "r1", 60, Seed.NEIGHBOUR, omitted=4))
        report = MergeReport(
            "r1.engram", "", ["r1"], revision=2, changed=True, taken=50, segments=segments
        )
        (line,) = [line for line in report.text().splitlines() if "5621beba" in line]
        assert "50 added, 4 already covered, in 51 segments, 50 not found" in line
        assert "no known node nearby (50)" in line


def test_a_dry_run_says_what_would_be_and_leaves_the_centre_alone(tmp_path, centre, fleet):
    robots = [fleet["longer"][0], fleet["same"][0]]
    before = centre.read_bytes()
    tried = merged(centre, *robots, dry_run=True)
    assert centre.read_bytes() == before
    assert list(tmp_path.iterdir()) == [centre] or hash_of(centre)
    done = merged(centre, *robots)
    assert [one.content_hash for one in tried] == [one.content_hash for one in done]
    assert [one.taken for one in tried] == [one.taken for one in done]
    assert "dry run" in tried[0].text()


def test_a_dry_run_makes_no_centre(tmp_path, fleet):
    merged(tmp_path / "new.engram", fleet["first"][0], dry_run=True)
    assert not (tmp_path / "new.engram").exists()


def test_the_picture_shows_the_centre_before_and_after(tmp_path, centre, fleet):
    picture = tmp_path / "merge.png"
    merged(centre, fleet["other"][0], picture=picture)
    assert picture.stat().st_size > 10_000


class TestGate:
    def test_worse_is_a_higher_curve_or_a_much_longer_gap(self):
        good = Drive(np.ones(40), np.arange(40) % 2 == 0)
        bad = Drive(np.ones(40), np.arange(40) % 20 == 0)
        assert what_is_worse([good], [good]) == ""
        assert what_is_worse([good], [bad]) == ""
        assert "P(no match within" in what_is_worse([bad], [good])
        assert "longest gap" in what_is_worse([bad], [good])

    def test_a_merge_that_makes_held_out_drives_worse_is_refused(
        self, tmp_path, centre, fleet, judged
    ):
        judged(WELL, WELL, BADLY)
        maps, told = [fleet["same"][0], fleet["longer"][0]], []
        with pytest.raises(RefusedError) as raised:
            merged(centre, *maps, require_better=[tmp_path / "held-out"], monitor=Told(told))
        assert str(maps[1]) in str(raised.value)
        assert "held-out localise worse" in str(raised.value)
        assert "the fleet map is unchanged" in str(raised.value)
        # What passed stands.
        assert [report.revision for report in told] == [2]
        assert hash_of(centre) == told[0].content_hash
        assert check_file(centre).problems == ()

    def test_a_drive_that_a_map_holds_is_not_held_out(self, tmp_path, centre, fleet):
        drive = frame_log(tmp_path / "drive.framelog", np.arange(0, 8, 0.8), 1, day=8)
        robot = tmp_path / "robot.engram"
        map_drive(robot, open_drive(drive), Settings(), RobotOptions(relocaliser="exhaustive"))
        before = centre.read_bytes()
        with pytest.raises(ConfigError, match=r"drive\.framelog is not held out: .*robot\.engram"):
            merged(centre, fleet["longer"][0], robot, require_better=[drive])
        assert centre.read_bytes() == before
        merged(centre, robot)
        with pytest.raises(ConfigError, match=r"not held out: .*centre\.engram contains"):
            merged(centre, fleet["longer"][0], require_better=[drive])

    def test_the_name_of_the_robot_does_not_make_a_drive_held_out(self, tmp_path, centre, fleet):
        drive = frame_log(tmp_path / "drive.framelog", np.arange(0, 8, 0.8), 1, day=8)
        robot = tmp_path / "robot.engram"
        renamed = open_drive(drive, robot="somebody")
        map_drive(robot, renamed, Settings(), RobotOptions(relocaliser="exhaustive"))
        merged(centre, robot)
        with pytest.raises(ConfigError, match=r"not held out: .*centre\.engram .*somebody"):
            merged(centre, fleet["longer"][0], require_better=[drive])

    def test_drives_that_begin_at_the_same_time_are_not_the_same(self, tmp_path):
        """Stamps of many data sets count from 0, and one camera drove all of them."""
        ours, theirs = (
            open_drive(frame_log(tmp_path / f"{name}.framelog", np.arange(0, 4, 0.8), name=name))
            for name in ("ours", "theirs")
        )
        sessions = [session_of_drive(theirs)]
        assert session_of_drive(ours).start_ns == sessions[0].start_ns
        check_held_out([("ours", ours)], sessions, "a map", "--check")
        with pytest.raises(ConfigError, match="theirs is not held out: a map contains"):
            check_held_out([("theirs", theirs)], sessions, "a map", "--check")

    def test_the_report_says_what_the_gate_saw(self, tmp_path, centre, fleet, judged):
        judged(BADLY, WELL)
        (report,) = merged(centre, fleet["other"][0], require_better=[tmp_path / "held-out"])
        told = json.loads(json.dumps(report.to_dict()))["held_out"]
        assert told["drives"] == ["held-out"]
        assert told["before"]["route_not_localised"] == 1.0
        assert told["before"]["longest_gap_m"] == pytest.approx(40.0)
        assert told["after"]["route_not_localised"] == 0.0
        assert told["after"]["p_no_match"] == {"5": 0.0, "10": 0.0, "20": 0.0}
        assert "route not localised 100.00% → 0.00%" in report.text()


def test_a_merge_that_serves_held_out_drives_passes_the_gate(tmp_path, centre, fleet, monkeypatch):
    held_out = frame_log(tmp_path / "held-out.framelog", np.arange(12, 36, 0.8), 0, day=8)
    asked, driven = RobotOptions(ranking="distance", lanes=4), []

    def spied(store, drive, settings, options, monitor):
        driven.append(options)
        return measure(store, drive, settings, options, monitor)

    monkeypatch.setattr("engram.fleet.merge.gate.measure", spied)
    (report,) = merged(centre, fleet["longer"][0], require_better=[held_out], localising=asked)
    assert driven == [asked, asked]  # before and after
    assert report.revision == 2
    assert report.held_out is not None
    assert report.held_out.after.route_not_localised < report.held_out.before.route_not_localised


def test_ctrl_c_ends_a_merge_between_two_nodes_and_the_next_one_completes_it(
    tmp_path, centre, fleet
):
    before = hash_of(centre)

    class Impatient(Monitor):
        count = 0

        def advance(self, word=""):
            self.count += 1
            if self.count == 5:
                signal.raise_signal(signal.SIGINT)

    (report,) = merged(centre, fleet["longer"][0], monitor=(impatient := Impatient()))
    assert report.interrupted
    assert impatient.count == 5
    assert hash_of(centre) == before
    whole = tmp_path / "whole.engram"
    expected = merged(whole, fleet["first"][0], fleet["longer"][0])[-1].content_hash
    assert merged(centre, fleet["longer"][0])[0].content_hash == expected
    assert check_file(centre).abandoned_rows == 0


class TestInterrupted:
    """Ctrl-C where no node is being looked at: at the gate, and in maps with nothing new."""

    @pytest.fixture
    def held_out(self, tmp_path):
        return frame_log(tmp_path / "held-out.framelog", np.arange(12, 24, 0.8), 0, day=8)

    @pytest.fixture
    def pressed(self, monkeypatch):
        """Presses Ctrl-C when this is called."""

        def press_at(target, name, call=1):
            really, calls = getattr(target, name), 0

            def pressed(*arguments, **options):
                nonlocal calls
                calls += 1
                if calls == call:
                    signal.raise_signal(signal.SIGINT)
                return really(*arguments, **options)

            monkeypatch.setattr(target, name, pressed)

        return press_at

    def test_at_the_gate_between_two_frames(self, centre, fleet, held_out):
        before = hash_of(centre)

        class Impatient(Monitor):
            """Counts frames, and nodes not: those are of a stage."""

            frames = 0

            def stage(self, what, total):
                return nullcontext(QUIET)

            def advance(self, word=""):
                self.frames += 1
                if self.frames == self.at:
                    signal.raise_signal(signal.SIGINT)

        impatient = Impatient()
        impatient.at = len(open_drive(held_out)) + 3  # all before the first merge
        maps = [fleet[name][0] for name in ("same", "longer")]
        (report,) = merged(centre, *maps, require_better=[held_out], monitor=impatient)
        assert report.interrupted
        assert impatient.frames == impatient.at
        assert hash_of(centre) == report.content_hash == before
        assert check_file(centre).problems == ()

    def test_when_the_gate_has_said_yes(self, centre, fleet, held_out, pressed):
        before = hash_of(centre)
        pressed(gate, "what_is_worse")
        (report,) = merged(centre, fleet["longer"][0], require_better=[held_out])
        assert report.interrupted
        assert hash_of(centre) == before

    def test_before_the_first_merge(self, centre, fleet, held_out, pressed):
        before, told = hash_of(centre), []
        pressed(merging.Gate, "look_at")
        with pytest.raises(KeyboardInterrupt):
            merged(centre, fleet["longer"][0], require_better=[held_out], monitor=Told(told))
        assert told == []
        assert hash_of(centre) == before

    def test_when_all_nodes_were_looked_at(self, centre, fleet, pressed):
        before = hash_of(centre)
        pressed(merging, "_carry_attempts")
        (report,) = merged(centre, fleet["longer"][0])
        assert report.interrupted
        assert hash_of(centre) == before

    def test_in_a_map_with_nothing_new(self, centre, fleet, pressed):
        pressed(merging, "notes")
        (report,) = merged(centre, fleet["first"][0], fleet["longer"][0])
        assert report.interrupted

    def test_when_a_merge_was_done_the_next_one_is_not_begun(self, centre, fleet, pressed):
        pressed(RevisionWriter, "commit")
        maps = [fleet[name][0] for name in ("other", "longer")]
        done, stopped = merged(centre, *maps)
        assert (done.interrupted, done.revision) == (False, 2)
        assert stopped.interrupted
        assert stopped.source == str(maps[1])
        assert hash_of(centre) == done.content_hash == stopped.content_hash

    def test_when_the_last_merge_was_done_whoever_called_hears_of_it(self, centre, fleet, pressed):
        told = []
        pressed(RevisionWriter, "commit")
        with pytest.raises(KeyboardInterrupt):
            merged(centre, fleet["longer"][0], monitor=Told(told))
        assert [report.revision for report in told] == [2]
        assert hash_of(centre) == told[0].content_hash


def kill_and_look(tmp_path: Path, fleet: dict, kills: int, seed: int) -> None:
    """Kill a merge at random moments: the centre is as before or complete, and sound."""
    rng = random.Random(seed)
    centre, whole = tmp_path / "centre.engram", tmp_path / "whole.engram"
    merged(centre, fleet["first"][0])
    before = hash_of(centre)
    after = merged(whole, fleet["first"][0], fleet["longer"][0])[-1].content_hash
    fresh = centre.read_bytes()
    seconds = 2.0
    for _ in range(kills):
        merging = subprocess.Popen(
            [sys.executable, "-m", "tests.fleet.merging_process", centre, fleet["longer"][0]],
            stdout=subprocess.PIPE,
            cwd=Path(__file__).parents[2],
            text=True,
        )
        assert merging.stdout is not None
        assert merging.stdout.readline() == "merging\n"
        done, _, _ = select.select([merging.stdout], [], [], rng.uniform(0, seconds))
        merging.kill()
        said = merging.communicate()[0]
        report = check_file(centre)
        assert report.problems == ()
        assert report.interrupted == ()
        assert hash_of(centre) in ({after} if said else {before, after})
        if hash_of(centre) == after:
            assert report.abandoned_rows == 0
            seconds *= 0.9 if done else 1.0
            for beside in tmp_path.glob("centre.engram*"):
                beside.unlink()
            centre.write_bytes(fresh)
        else:
            seconds *= 1.05
    assert merged(centre, fleet["longer"][0])[0].content_hash == after
    assert check_file(centre).problems == ()


def test_killed_at_any_moment_the_centre_is_as_before_or_complete(tmp_path, fleet):
    kill_and_look(tmp_path, fleet, kills=2, seed=1)


@pytest.mark.long
def test_killed_many_times_the_centre_is_as_before_or_complete(tmp_path, fleet):
    kill_and_look(tmp_path, fleet, kills=30, seed=2)


def test_a_centre_with_an_interrupted_session_of_that_robot_says_so(tmp_path, fleet):
    robot, centre = tmp_path / "robot.engram", tmp_path / "centre.engram"
    robot_map(robot, np.arange(0, 10, 0.5), 0, name="r1", day=1)
    with Map.open(robot) as given, Map.create(centre) as store:
        (session,) = given.load().sessions
        (camera,) = given.load().cameras.values()
        kind, frontend = given.frontends[session.id]
        store.begin_session(
            session, camera, descriptor=kind, frontend=frontend, author="r1", configuration={}
        )
    with pytest.raises(MapError, match="resume it or seal"):
        merged(centre, robot)


def test_an_unknown_policy_is_refused_before_anything_is_made(tmp_path, fleet):
    with pytest.raises(InputError, match="nonsense"):
        merge(tmp_path / "c.engram", [fleet["first"][0]], MergeOptions(ranking="nonsense"))
    assert not (tmp_path / "c.engram").exists()
