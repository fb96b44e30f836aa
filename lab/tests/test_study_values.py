"""Values that a study rests on: each test fails if one of them is off."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from tests.fleet.robots import frame_log

from engram.errors import InputError
from engram.fleet.build.building import BuildReport
from engram.fleet.build.scratch import GroupResult
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.merge.gate import what_is_worse
from engram.graph.basin import BASIN_LEVEL, MatchBasin
from engram.graph.model import SessionId, session_id
from engram.measures import Drive
from engram.ranking.policies import POLICIES, policy_named
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive
from engram.testing.contracts import make_context
from engram_lab import trial
from engram_lab.studies.fleet.report import Parallel, Time
from engram_lab.studies.fleet.steps import _united


def test_path_near_ranks_by_paths_only_where_six_in_ten_would_match():
    """The farther node shares every path with k, and would match in four of ten attempts."""
    basin = MatchBasin.of(256.0)
    offsets = np.arange(0.25, 4.0, 0.5)
    rates = basin.success_rate(offsets, np.zeros_like(offsets))
    doubtful = float(offsets[np.flatnonzero((rates < 0.55) & (rates > 0.32))[0]])
    context = make_context(
        candidates=[1, 2], paths=[[0, 2]] * 5, along_m=np.array([0.2, doubtful]), reference=0,
        observed=(0,), outcomes=(True,),
    )  # fmt: skip
    assert BASIN_LEVEL == 0.6
    assert POLICIES["path"]().rank(context).tolist() == [1, 0]
    assert policy_named("path-near").rank(context).tolist() == [0, 1]


def test_maps_are_compared_up_to_twenty_metres():
    """Better at every distance up to 10 m, worse at 11."""
    often, once = (
        Drive(np.ones(200), np.array(list("x" + f"{gap}" * count + "x" * 300))[:200] == "x")
        for gap, count in (("." * 10 + "x", 5), ("." * 13 + "x", 1))
    )
    assert "within 1" in what_is_worse([once], [often])


def test_parallel_time_is_that_of_the_slowest_group():
    report = BuildReport("c", mapped=[GroupResult(0, seconds=10.0), GroupResult(1, seconds=2.0)])
    report.merged_before_s = 3.0
    assert report.parallel_s == 13.0
    times = [Time(10.0, 20.0), Time(2.0, 4.0)]
    assert Parallel([], [], times, [Time(3.0, 5.0)], []).time == Time(13.0, 25.0)


def test_a_missions_hour_is_that_of_its_own_drive(tmp_path, monkeypatch):
    logs = [
        frame_log(tmp_path / f"{hour}.framelog", np.arange(0.0, 3.0), name=f"r{hour}", hour=hour)
        for hour in (8, 17)
    ]
    asked = []

    def refuses(centre, out, options, **_):
        asked.append(options)
        raise InputError("nothing fits")

    monkeypatch.setattr(trial, "download", refuses)
    monkeypatch.setattr(trial, "check_not_sent", lambda *_: None)
    drives = [lambda log=log: open_drive(log) for log in logs]
    left = []
    trial.try_downloads(
        tmp_path / "none.engram", {"tod": DownloadOptions("tod")}, drives, Settings(),
        RobotOptions(), left_out=left.append,
    )  # fmt: skip
    assert [one.depart_h for one in asked] == pytest.approx([8.0, 17.0])
    assert [one.depart_h for one in left] == pytest.approx([8.0, 17.0])


def test_nodes_of_a_parallel_build_are_those_after_the_last_merge():
    merges = [SimpleNamespace(nodes=5), SimpleNamespace(nodes=9)]
    assert Parallel([], merges, [], [], []).nodes == 9


def test_united_counts_own_nodes_and_what_was_sent_once():
    own, other = (SessionId(session_id(name, "c", 0, "h")) for name in ("own", "other"))
    nodes = [SimpleNamespace(session=own)] * 4 + [SimpleNamespace(session=other)] * 3
    sent = SimpleNamespace(nodes=nodes[3:6])  # one own, two of another
    assert _united(sent, nodes, {own}) == 4 + 2
