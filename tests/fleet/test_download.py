"""What a download holds, that it is whole, and that a robot can work with nothing else."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.builders import attempts_of, drive, localise_simulated, map_simulated

from engram.errors import ConfigError, InputError, MapError, NotAMapError, RevisionError
from engram.fleet.download.downloading import DownloadReport, download, most_that_fit
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.selections import SELECTIONS, UNDERSTOOD
from engram.frontend.frame import BRIEF
from engram.graph.model import Amendable, EdgeKind, path_id
from engram.maps.map import Map
from engram.maps.map_files import check_file, copy_map
from engram.places.vocabulary import default_vocabulary
from engram.places.words import NodeWords

from .robots import DAY_NS, WORLD, merged

HOUR_NS = 3_600_000_000_000
# Robot, hour of day, from, to (metres), and up to where the street looks as in the morning: two
# mornings and two evenings of one street. The evenings never saw the same place as each other.
DRIVES = (
    ("r1", 9.0, 0, 40, 40),
    ("r2", 18.0, 0, 15, 3),
    ("r3", 9.5, 20, 60, 60),
    ("r4", 23.75, 25, 60, 28),
)


def steps_of(
    hour: float,
    start_m: float,
    end_m: float,
    morning_to_m: float,
    *,
    day: int,
    aside_m: float = 0.0,
):
    begin_ns = day * DAY_NS + round(hour * HOUR_NS)
    places = np.arange(start_m, end_m, 0.5)
    appearance = np.where(places < morning_to_m, 0, 1)
    return drive(WORLD, places, appearance, aside_m=aside_m, start_ns=begin_ns, seed=day)


@pytest.fixture(scope="module")
def centre(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("fleet") / "centre.engram"
    for day, (name, hour, *way) in enumerate(DRIVES, start=1):
        steps = steps_of(hour, *way, day=day, aside_m=0.1 * day)
        map_simulated(path, steps, name, longitude_deg=0.0)
    return path


def sent(centre: Path, out: Path, select: str, **options) -> DownloadReport:
    return download(centre, out, DownloadOptions(select, **options))


def robots_of(path: Path) -> dict[str, int]:
    """How many nodes of each robot a map holds."""
    with Map.open(path) as store:
        contents = store.load()
    names = {session.id: session.robot for session in contents.sessions}
    found = [names[node.session] for node in contents.nodes]
    return {name: found.count(name) for name in sorted(set(found))}


def node_ids(path: Path) -> set:
    with Map.open(path) as store:
        return {node.id for node in store.load().nodes}


POLICIES = {
    "copy": {},
    "tod": {"depart_h": 9.0, "window_min": 60.0},
    "paths": {"depart_h": 18.0, "arrive_h": 18.0},
    "tod+paths": {"depart_h": 9.0, "window_min": 60.0, "best_percent": 50.0},
    "route": {"route": None, "radius_m": 3.0},
    "budget": {"budget_bytes": 600_000, "depart_h": 9.0},
}


@pytest.mark.parametrize("policy", POLICIES)
def test_every_download_is_sound_and_the_same_every_time(centre, tmp_path, policy):
    options = dict(POLICIES[policy])
    if policy == "route":
        with Map.open(centre) as store:
            options["route"] = str(store.load().sessions[0].id)
    one = sent(centre, tmp_path / "one.engram", policy, **options)
    again = sent(centre, tmp_path / "again.engram", policy, **options)
    assert (tmp_path / "one.engram").read_bytes() == (tmp_path / "again.engram").read_bytes()
    assert one.content_hash == again.content_hash
    assert check_file(tmp_path / "one.engram").problems == ()
    assert 0 < one.nodes <= one.of_nodes
    assert [file.name for file in sorted(tmp_path.iterdir())] == ["again.engram", "one.engram"]


@pytest.mark.parametrize("policy", ["copy", "tod", "budget"])
def test_merging_an_unchanged_download_changes_nothing(centre, tmp_path, policy):
    mine = Path(shutil.copy(centre, tmp_path / "centre.engram"))
    sent(mine, tmp_path / "robot.engram", policy, **POLICIES[policy])
    with Map.open(mine) as store:
        before = store.revision, store.content_hash()
    (report,) = merged(mine, tmp_path / "robot.engram")
    assert report.revision is None
    with Map.open(mine) as store:
        assert (store.revision, store.content_hash()) == before


def test_amendments_go_along_and_come_back_once(centre, tmp_path):
    mine, out = Path(shutil.copy(centre, tmp_path / "centre.engram")), tmp_path / "robot.engram"
    with Map.open(mine) as store:
        recorded = next(iter(store.sessions.values()))
        store.amend(recorded.id, {Amendable.ROBOT: "lorry"}, author="tests")
    sent(mine, out, "copy")
    with Map.open(out) as store:
        shown = store.sessions[recorded.id]
        assert (shown.robot, shown.as_recorded) == ("lorry", recorded)
        store.amend(recorded.id, {Amendable.ROBOT: "van"}, author="tests")
    (report,) = merged(mine, out)
    assert report.revision is not None
    (again,) = merged(mine, out)
    assert again.revision is None
    with Map.open(mine) as store:
        assert store.sessions[recorded.id].robot == "van"
        assert [one.value for one in store.amendments] == ["lorry", "van"]
    assert check_file(mine).problems == ()


def test_copy_holds_all_that_the_centre_shows(centre, tmp_path):
    report = sent(centre, tmp_path / "robot.engram", "copy")
    with Map.open(centre) as ours, Map.open(tmp_path / "robot.engram") as theirs:
        mine, given = ours.load(), theirs.load()
        assert set(mine.nodes) == set(given.nodes)
        assert set(mine.sessions) == set(given.sessions)
        assert set(mine.path_entries) == set(given.path_entries)
        assert len(mine.attempts) == len(given.attempts)
        for session in mine.sessions:
            assert attempts_of(mine, session.id) == attempts_of(given, session.id)
        keys = [{(e.a, e.b, e.kind) for e in one.edges} for one in (mine, given)]
        assert keys[0] == keys[1]
        assert ours.landmark_hashes == theirs.landmark_hashes
        assert theirs.partial_paths == frozenset()
        assert theirs.log()[0].committed_ns == ours.log()[-1].committed_ns
        assert theirs.log()[0].configuration["download"]["source"] == ours.content_hash()
    assert (report.bridges, report.expected_missed) == (0, report.copy_missed)


def test_words_go_along_and_make_no_difference_to_the_bytes(centre, tmp_path):
    vocabulary = default_vocabulary(BRIEF)
    sent(centre, tmp_path / "before.engram", "tod", depart_h=9.0)
    keeping = tmp_path / "keeping.engram"
    copy_map(centre, keeping)
    with Map.open(keeping, writes=True) as store:
        nodes = [node.id for node in store.load().nodes]
        words = NodeWords.of_map(store, vocabulary)
        assert not words.stored(nodes)
        words.keep_missing()
        kept = words.stored(nodes)
    sent(keeping, tmp_path / "after.engram", "tod", depart_h=9.0)
    with Map.open(tmp_path / "after.engram") as store:
        went = NodeWords.of_map(store, vocabulary).stored(nodes)
    assert set(went) == node_ids(tmp_path / "after.engram")
    assert all(np.array_equal(words, kept[node]) for node, words in went.items())
    assert (tmp_path / "before.engram").read_bytes() == (tmp_path / "after.engram").read_bytes()


def test_tod_sends_what_was_saved_near_that_hour_over_midnight_too(centre, tmp_path):
    everything = robots_of(centre)
    sent(centre, tmp_path / "morning.engram", "tod", depart_h=9.0, window_min=60.0)
    assert robots_of(tmp_path / "morning.engram") == {
        name: everything[name] for name in ("r1", "r3")
    }
    # 23:45 and later is within 30 minutes of 0:05.
    sent(centre, tmp_path / "night.engram", "tod", depart_h=5 / 60, window_min=30.0)
    assert robots_of(tmp_path / "night.engram") == {"r4": everything["r4"]}


def test_paths_send_every_node_of_the_chosen_drives(centre, tmp_path):
    report = sent(centre, tmp_path / "out.engram", "paths", depart_h=18.0, arrive_h=18.0)
    with Map.open(centre) as store:
        contents = store.load()
    r2 = next(session for session in contents.sessions if session.robot == "r2")
    assert report.why["epochs"] == [18]
    assert str(path_id(r2.id)) in report.why["paths"]
    chosen = set(report.why["paths"])
    expected = {e.node for e in contents.path_entries if str(e.path) in chosen}
    assert node_ids(tmp_path / "out.engram") == expected


def test_tod_and_paths_send_what_passes_both(centre, tmp_path):
    both = sent(centre, tmp_path / "both.engram", "tod+paths", depart_h=9.0, window_min=60.0)
    sent(centre, tmp_path / "tod.engram", "tod", depart_h=9.0, window_min=60.0)
    assert node_ids(tmp_path / "both.engram") <= node_ids(tmp_path / "tod.engram")
    assert both.nodes > 0


def test_entries_left_behind_make_a_path_partial(centre, tmp_path):
    with Map.open(centre) as store:
        first = store.load().nodes[0]
    report = sent(centre, tmp_path / "out.engram", "region", near=(str(first.id),), radius_m=5.0)
    assert 3 <= report.nodes < report.of_nodes / 2
    with Map.open(tmp_path / "out.engram") as store:
        contents = store.load()
        partial = store.partial_paths
        assert {entry.path for entry in contents.path_entries} == partial
        for node in contents.nodes:
            assert len(store.frames.frame(node.id).landmarks) > 0


def test_gaps_are_closed_by_bridges_and_no_more_pieces_come(centre, tmp_path):
    # The evenings hang together through the mornings only.
    report = sent(centre, tmp_path / "out.engram", "tod", depart_h=21.0, window_min=180.0)
    with Map.open(tmp_path / "out.engram") as store:
        kinds = store.info().edges_of_kind
    assert set(robots_of(tmp_path / "out.engram")) == {"r2", "r4"}
    assert kinds["bridge"] == report.bridges >= 1
    assert report.components == 1
    # From 15 m to 25 m nothing is there: a robot that drives on finds itself again beyond.
    whole = steps_of(18.5, 0, 60, 0, day=9)
    known = [one.node is not None for one in localise_simulated(tmp_path / "out.engram", whole)]
    assert np.mean(known[8:26]) > 0.9
    assert np.mean(known[62:]) > 0.9


def test_a_budget_is_kept_and_more_of_it_promises_more(centre, tmp_path):
    whole = sent(centre, tmp_path / "copy.engram", "copy")
    before = 1.1
    for percent in (30, 60, 100):
        out = tmp_path / f"{percent}.engram"
        budget = whole.size_bytes * percent // 100
        report = sent(centre, out, "budget", budget_bytes=budget, depart_h=9.2)
        assert out.stat().st_size == report.size_bytes <= budget
        assert report.expected_missed <= before
        before = report.expected_missed
    assert report.nodes >= 0.95 * whole.of_nodes  # 96 % of the budget ends the search
    small = robots_of(tmp_path / "30.engram")
    # Nine in the morning: the mornings are worth more than the evenings.
    assert small.get("r1", 0) + small.get("r3", 0) > 2 * (small.get("r2", 0) + small.get("r4", 0))


def test_a_budget_can_be_a_share_of_everything_sent_alike(centre, tmp_path):
    everything = sent(centre, tmp_path / "all.engram", "budget", budget_percent=100, depart_h=9.2)
    assert everything.nodes == everything.of_nodes
    assert everything.why["everything_bytes"] == everything.size_bytes
    half = sent(centre, tmp_path / "half.engram", "budget", budget_percent=50, depart_h=9.2)
    estimated = half.why["everything_bytes"]
    assert abs(estimated - everything.size_bytes) < 0.05 * everything.size_bytes
    assert 0.9 < half.size_bytes / (estimated // 2) <= 1
    as_bytes = sent(
        centre,
        tmp_path / "bytes.engram",
        "budget",
        budget_bytes=everything.size_bytes // 2,
        depart_h=9.2,
    )
    assert abs(as_bytes.nodes - half.nodes) <= 3
    assert "of the" in half.text()
    assert "of a full download in the same form" in half.text()


def test_a_robot_works_with_the_download_alone_and_hands_back_what_it_added(centre, tmp_path):
    mine = Path(shutil.copy(centre, tmp_path / "centre.engram"))
    robot = tmp_path / "robot.engram"
    sent(mine, robot, "tod", depart_h=9.0, window_min=60.0)
    morning = steps_of(9.2, 0, 40, 40, day=7, aside_m=0.4)
    found = localise_simulated(robot, morning)
    assert np.mean([one.node is not None for one in found]) > 0.9
    # At noon the street looks new from 10 m to 30 m.
    places = np.arange(0, 40, 0.5)
    appearance = np.where((places < 10) | (places >= 30), 0, 2)
    noon = drive(WORLD, places, appearance, start_ns=8 * DAY_NS + 12 * HOUR_NS, seed=8)
    added = map_simulated(robot, noon, "r5", longitude_deg=0.0).saved
    assert len(added) > 10
    (report,) = merged(mine, robot)
    assert (report.revision, report.taken) == (5, len(added))
    assert report.components == 1
    assert check_file(mine).problems == ()
    with Map.open(mine) as store:
        contents = store.load()
    assert {node.id for node in contents.nodes} >= set(added)
    assert not any(edge.kind is EdgeKind.BRIDGE for edge in contents.edges)
    # The next robot that leaves at noon gets it.
    sent(mine, tmp_path / "next.engram", "tod", depart_h=12.0, window_min=30.0)
    assert node_ids(tmp_path / "next.engram") == set(added)


def test_as_of_an_older_revision_or_tag(centre, tmp_path):
    mine = Path(shutil.copy(centre, tmp_path / "centre.engram"))
    with Map.open(mine, writes=True) as store:
        store.tag("first", 1, author="me")
    options = DownloadOptions()
    report = download(mine, tmp_path / "old.engram", options, at="first")
    assert report.revision == 1
    assert list(robots_of(tmp_path / "old.engram")) == ["r1"]
    with pytest.raises(RevisionError, match="'second'"):
        download(mine, tmp_path / "none.engram", options, at="second")


def test_what_was_taken_back_is_not_sent(centre, tmp_path):
    mine = Path(shutil.copy(centre, tmp_path / "centre.engram"))
    with Map.open(mine, writes=True) as store:
        store.revert(2, author="me")
    sent(mine, tmp_path / "out.engram", "copy")
    assert "r2" not in robots_of(tmp_path / "out.engram")
    assert check_file(tmp_path / "out.engram").problems == ()


class TestMostThatFit:
    """Files of a size as a test says: what every file holds, and nodes that take what they take."""

    @given(
        st.lists(st.integers(2_000, 60_000), min_size=1, max_size=300),
        st.integers(0, 20_000_000),
        st.floats(0.8, 1.25),
        st.floats(0.0, 1.2),
    )
    def test_it_fits_and_leaves_little_free(self, node_bytes, held_bytes, growth, share):
        taken = np.cumsum(node_bytes) * growth
        expected = held_bytes + np.cumsum(node_bytes)
        written = []

        def measure(count):
            written.append(count)
            return held_bytes + int(taken[count - 1])

        # From no room for a node to room for all of them and more.
        budget = held_bytes + int(share * taken[-1])
        if measure(1) > budget:
            with pytest.raises(InputError, match=f"take {measure(1)} bytes;"):
                most_that_fit(measure, expected, budget)
            return
        written.clear()
        count = most_that_fit(measure, expected, budget)
        assert len(written) <= 2
        assert written[-1] == count
        assert measure(count) <= budget
        assert count == len(node_bytes) or measure(count + 1) > 0.9 * budget

    def test_sizes_that_are_not_as_expected_still_fit_well(self):
        rng = np.random.default_rng(3)
        expected = np.cumsum(rng.uniform(10_000, 30_000, 2_000))
        # Nodes added late bring fewer edges with them.
        real = 3_000_000 + expected * np.linspace(1.3, 0.9, 2_000)
        for budget in np.linspace(real[0], real[-1], 40):
            count = most_that_fit(lambda n: int(real[n - 1]), 3e6 + expected, int(budget) + 1)
            assert 0.9 * budget <= real[count - 1] <= budget + 1


class TestMistakes:
    @pytest.mark.parametrize(
        ("options", "says"),
        [
            ({"select": "best"}, "known: copy, tod"),
            ({"select": "tod"}, "needs --depart"),
            ({"select": "tod+paths"}, "needs --depart"),
            ({"select": "budget"}, "needs --budget"),
            ({"select": "region"}, "needs --near"),
            ({"select": "route"}, "needs --route"),
            ({"select": "tod", "depart_h": 24.0}, "depart_h is 24.0"),
            ({"select": "tod", "depart_h": float("nan")}, "depart_h is nan"),
            ({"window_min": -1.0}, "window_min is -1.0, must be >= 0"),
            ({"epoch_min": 0.0}, "epoch_min is 0.0"),
            ({"best_percent": 101.0}, "best_percent is 101.0"),
            ({"budget_bytes": 0}, "budget_bytes is 0"),
            ({"budget_percent": 0.0}, "budget_percent is 0.0"),
            ({"budget_percent": 101.0}, "budget_percent is 101.0"),
            ({"budget_percent": float("nan")}, "budget_percent is nan"),
            ({"budget_percent": 10.0, "budget_bytes": 9}, "give one"),
            ({"radius_m": float("inf")}, "radius_m is inf"),
        ],
    )
    def test_options_that_do_not_fit(self, centre, tmp_path, options, says):
        policy = options.pop("select", "copy")
        with pytest.raises(ConfigError, match=says):
            sent(centre, tmp_path / "out.engram", policy, **options)
        assert not (tmp_path / "out.engram").exists()

    @pytest.mark.parametrize(
        ("options", "says"),
        [
            (
                {"select": "tod", "depart_h": 13.0, "window_min": 30.0, "strict": True},
                "no node was saved within 30",
            ),
            (
                {"select": "paths", "depart_h": 12.0, "arrive_h": 13.0, "strict": True},
                "no epoch from 12:00 to 13:00",
            ),
            ({"select": "region", "near": ("zz",)}, "is not a UUID"),
            ({"select": "region", "near": ("00000000",)}, "begins with"),
            ({"select": "route", "route": "00000000"}, "0 sessions begin with"),
            ({"select": "budget", "budget_bytes": 5000}, "not one node fits into 5000"),
        ],
    )
    def test_nothing_to_send(self, centre, tmp_path, options, says):
        with pytest.raises(InputError, match=says):
            sent(centre, tmp_path / "out.engram", **options)
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize(
        ("options", "says"),
        [
            ({"select": "copy", "route": "zzzz"}, "copy does not use --route"),
            ({"select": "copy", "near": ("ffff",)}, "does not use --near"),
            ({"select": "tod", "depart_h": 9.0, "budget_bytes": 10_000}, "choose --select budget"),
            ({"select": "copy", "route": "0"}, "choose --select tod, paths"),
            ({"select": "region", "near": ("0",), "budget_bytes": 10_000}, "use --budget"),
            ({"select": "region", "near": ("0",), "budget_percent": 50.0}, "use --budget"),
            ({"select": "budget", "budget_bytes": 9, "near": ("0",), "route": "0"}, "only one of"),
            ({"select": "copy", "arrive_h": 9.0}, "needs --depart with --arrive"),
            ({"select": "copy", "date": "2026-11-17"}, "at --depart"),
        ],
    )
    def test_options_that_a_policy_would_pass_over(self, centre, tmp_path, options, says):
        with pytest.raises(ConfigError, match=says):
            sent(centre, tmp_path / "out.engram", **options)
        assert list(tmp_path.iterdir()) == []

    def test_every_option_has_a_policy_that_goes_by_it(self):
        assert UNDERSTOOD.keys() == SELECTIONS.keys()
        mission = {"depart_h", "arrive_h", "date", "latitude_deg"}
        settings = {
            "window_min",
            "epoch_min",
            "best_percent",
            "buffer_min",
            "radius_m",
            "widen_min",
        }
        fields = {one.name for one in dataclasses.fields(DownloadOptions)}
        assert frozenset().union(*UNDERSTOOD.values()) == fields - mission - settings - {
            "select",
            "thumbnails",
        }

    def test_nothing_is_there_where_the_report_fails(self, centre, tmp_path, monkeypatch):
        def fails(*_):
            raise MapError("no report")

        monkeypatch.setattr("engram.fleet.download.downloading._report", fails)
        with pytest.raises(MapError, match="no report"):
            sent(centre, tmp_path / "out.engram", "tod", depart_h=9.0)
        assert list(tmp_path.iterdir()) == []

    def test_places_that_cannot_be_read_or_written(self, centre, tmp_path):
        (tmp_path / "there.engram").touch()
        for out, says in (("there.engram", "exists already"), ("no/out.engram", "is not a folder")):
            with pytest.raises(InputError, match=says):
                sent(centre, tmp_path / out, "copy")
        with pytest.raises(NotAMapError):
            sent(tmp_path / "there.engram", tmp_path / "out.engram", "copy")
        Map.create(tmp_path / "empty.engram").close()
        with pytest.raises(InputError, match="holds no nodes"):
            sent(tmp_path / "empty.engram", tmp_path / "out.engram", "copy")

    @pytest.mark.parametrize("policy", ["tod", "paths", "tod+paths", "budget"])
    def test_a_map_without_hours_of_day_says_what_it_lacks(self, tmp_path, policy):
        timeless = tmp_path / "timeless.engram"
        map_simulated(timeless, steps_of(9.0, 0, 5, 5, day=1), "r1")
        options = {"budget_bytes": 10**6} if policy == "budget" else {}
        with pytest.raises(InputError, match=r"1 of 1 sessions \(r1 .*engram amend"):
            sent(timeless, tmp_path / "out.engram", policy, depart_h=9.0, **options)
        # Without a time it can be chosen by what promises most.
        assert sent(timeless, tmp_path / "out.engram", "budget", budget_bytes=10**6).nodes > 0


def test_options_are_plain_values():
    assert dataclasses.asdict(DownloadOptions())["select"] == "copy"
