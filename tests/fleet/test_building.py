"""Building in groups: the same map whatever dies on the way, and the best order of merging."""

from __future__ import annotations

import multiprocessing
import os
import select
import signal
import subprocess
import sys
from contextlib import contextmanager
from itertools import permutations
from pathlib import Path

import pytest

from engram.errors import ConfigError, EngramError, SequenceError, WorkerError
from engram.fleet.build.building import build_map
from engram.fleet.build.orders import JudgeOptions, order_costs
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.monitor import Monitor
from engram.robot.settings import RobotOptions, Settings

from .builds import Interrupting, build, options


@pytest.fixture(scope="module")
def built(tmp_path_factory, logs):
    """The centre of groups (a, b), (c) built without any trouble."""
    centre = tmp_path_factory.mktemp("built") / "centre.engram"
    return centre, build(centre, logs)


def test_groups_are_mapped_and_merged_into_one_map(built, logs):
    centre, report = built
    assert report.groups == [["a.framelog", "b.framelog"], ["c.framelog"]]
    assert [len(one.sessions) for one in report.mapped] == [2, 1]
    assert all(one.seconds > 0 and one.retries == 0 for one in report.mapped)
    assert len(report.merges) == 1
    assert check_file(centre).problems == ()
    assert not centre.with_name("centre.engram.build").exists()
    with Map.open(centre) as store:
        assert len(store.load().sessions) == 3
        assert store.content_hash() == report.content_hash
    assert "2 drives" in report.text()
    assert report.to_dict()["parallel_s"] == pytest.approx(report.parallel_s)


@pytest.mark.long
def test_a_worker_that_dies_is_replaced_and_the_map_is_the_same(tmp_path, logs, built):
    killed = []

    class Killing(Monitor):
        def advance(self, word=""):
            if not killed:  # the first word of any worker is its last
                killed.append(multiprocessing.active_children()[0].pid)
                os.kill(killed[0], signal.SIGKILL)

    report = build(tmp_path / "centre.engram", logs, monitor=Killing())
    assert len(killed) == 1
    assert sum(one.retries for one in report.mapped) == 1
    assert report.content_hash == built[1].content_hash


@contextmanager
def process_of_a_build(*arguments):
    """A process that builds, after the first word from a worker of it."""
    command = [sys.executable, "-m", "tests.fleet.building_process", *map(str, arguments)]
    tests = Path(__file__).parents[2]
    with subprocess.Popen(command, cwd=tests, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline()
        yield process


def test_no_worker_outlives_a_build_that_is_killed():
    with process_of_a_build() as process:
        process.kill()
        # The worker has the same end of the pipe: it ends only when both are gone.
        assert select.select([process.stdout], [], [], 60.0)[0]
        assert process.stdout.read() == b""


@pytest.mark.long
def test_a_build_that_is_killed_goes_on_at_once_and_comes_to_the_same_map(tmp_path, logs, built):
    centre = tmp_path / "centre.engram"
    with process_of_a_build(centre, *(logs[name] for name in "abc")) as process:
        process.kill()
        process.wait()
        report = build(centre, logs)
    assert report.content_hash == built[1].content_hash
    assert [one.nodes for one in report.mapped] == [one.nodes for one in built[1].mapped]


@pytest.mark.long
def test_a_group_that_kills_every_worker_is_given_up(tmp_path, logs):
    class Killing(Monitor):
        def advance(self, word=""):
            for child in multiprocessing.active_children():
                os.kill(child.pid, signal.SIGKILL)

    centre = tmp_path / "centre.engram"
    with pytest.raises(WorkerError, match="died 4 times"):
        build(centre, logs, names="a", groups=1, workers=1, monitor=Killing())
    assert not centre.exists()


@pytest.mark.long
def test_an_interrupted_build_goes_on_and_comes_to_the_same_map(tmp_path, logs, built):
    centre = tmp_path / "centre.engram"
    report = build(centre, logs, monitor=Interrupting(25))
    assert report.interrupted
    assert "run the same command to continue" in report.text()
    with pytest.raises(ConfigError, match="another, incomplete build"):
        build(centre, logs, groups=3)
    again = build(centre, logs)
    assert not again.interrupted
    assert again.content_hash == built[1].content_hash


@pytest.mark.long
def test_a_centre_that_exists_takes_in_all_groups(tmp_path, logs):
    centre = tmp_path / "centre.engram"
    build(centre, logs, names="a", groups=1)
    report = build(centre, logs, names="bc")
    assert [one.revision for one in report.merges] == [2, 3]
    assert report.left_out == []


@pytest.mark.long
def test_drives_that_the_centre_has_are_not_mapped_again(tmp_path, logs):
    centre = tmp_path / "centre.engram"
    first = build(centre, logs, names="ab", groups=1)
    again = build(centre, logs, names="ab")
    assert again.left_out == ["a.framelog", "b.framelog"]
    assert (again.groups, again.mapped, again.merges) == ([], [], [])
    assert again.content_hash == first.content_hash
    assert "nothing new" in again.text()
    more = build(centre, logs, names="abc")
    assert more.left_out == ["a.framelog", "b.framelog"]
    assert more.groups == [["c.framelog"]]
    assert "left out" in more.text()
    with Map.open(centre) as store:
        assert len(store.load().sessions) == 3


@pytest.mark.long
def test_what_a_build_leaves_out_does_not_change_when_it_goes_on(tmp_path, logs):
    centre = tmp_path / "centre.engram"
    build(centre, logs, names="a", groups=1)
    interrupted = build(centre, logs, names="abc", monitor=Interrupting(25))
    assert interrupted.interrupted
    report = build(centre, logs, names="abc")
    assert report.left_out == ["a.framelog"]
    assert report.groups == [["b.framelog"], ["c.framelog"]]


def test_a_drive_that_cannot_be_read_is_named(tmp_path, logs):
    (tmp_path / "broken.framelog").write_bytes(b"nothing")
    with pytest.raises(EngramError, match=r"broken\.framelog"):
        build_map(tmp_path / "c.engram", [str(tmp_path / "broken.framelog")], Settings(), options())
    with pytest.raises(SequenceError, match="cannot be fetched"):
        build_map(tmp_path / "c.engram", ["memory://nowhere.framelog"], Settings(), options())


@pytest.mark.long
def test_all_orders_are_tried_over_a_prefix_tree_and_the_best_is_kept(tmp_path, logs):
    centre = tmp_path / "centre.engram"
    judge = JudgeOptions(
        [logs["held-out"]], 3.0, RobotOptions(relocaliser="exhaustive", lanes=1, rounds=8)
    )
    report = build(centre, logs, groups=3, judge=judge)
    best = report.best
    assert {one.order for one in best.results} == set(permutations(range(3)))
    # Σ 3!/(3−d)! over d = 2, 3 merges, and a copy for every node of the tree.
    assert (best.spent.merges, best.spent.copies) == (6 + 6, 3 + 6 + 6)
    assert [one.rank for one in best.results] == sorted(one.rank for one in best.results)
    # What was chosen was really built: the centre is the map that was judged.
    assert report.content_hash == best.results[0].content_hash
    assert report.groups == [[f"{'abc'[number]}.framelog"] for number in best.order]
    assert "model (8)" in report.text()
    assert len(report.to_dict()["best_order"]["orders"]) == 6


def test_the_cost_model_gives_the_papers_figure():
    costs = order_costs(4, 10823, 1829, 27)
    assert costs.model_s / costs.sequential_s == pytest.approx(0.2244, abs=5e-5)
    # 60 merges in place of 72; 64 T_G for a tree of sequential building.
    assert costs.tree_s == pytest.approx(4 * 10823 + 60 * 1829 + 64 * 27)
    assert costs.sequential_tree_s == pytest.approx(64 * 10823 + 64 * 27)


def test_what_cannot_be_built_is_refused(tmp_path, logs):
    with pytest.raises(ConfigError, match="budgets by count"):
        options(mapping=RobotOptions(deadline_ms=10.0))
    with pytest.raises(ConfigError, match="validation"):
        JudgeOptions([])
    with pytest.raises(ConfigError, match="0 workers"):
        options(workers=0)


@pytest.mark.long
def test_a_dask_cluster_builds_the_same_map(tmp_path, logs, built):
    distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        local_directory=str(tmp_path / "dask"),
    ) as cluster:
        report = build(tmp_path / "centre.engram", logs, scheduler=cluster.scheduler_address)
    assert report.content_hash == built[1].content_hash
