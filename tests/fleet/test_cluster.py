"""Groups on a Dask cluster: heard while they are mapped, stopped when asked, tried in vain once."""

from __future__ import annotations

import threading
from concurrent.futures import Future
from types import SimpleNamespace

import pytest

from engram.errors import SequenceError, WorkerError
from engram.fleet.build import cluster
from engram.fleet.build.cluster import map_groups_on_cluster
from engram.fleet.build.scratch import GroupTask
from engram.maps.map_files import check_file
from engram.monitor import Monitor
from engram.processes import _WORDS_AT_ONCE
from engram.robot.settings import Settings

from .builds import build, options

dask = pytest.importorskip("dask", reason="the extra `cluster` is not installed")
distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")


@pytest.fixture
def scheduler():
    """A scheduler with one worker, in this process."""
    quick = dask.config.set({"distributed.comm.timeouts.connect": "1s"})  # to give a lost one up
    with (
        quick,
        distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=1,
            processes=False,
            protocol="tcp",
            dashboard_address=None,
        ) as started,
    ):
        yield started


class Watching(Monitor):
    """Passes words and questions on to functions."""

    def __init__(self, advance=lambda _: None, check=lambda: None):
        self.advance = advance
        self.check = check


def run(started, tmp_path, sources, *watching):
    """Maps groups of one drive each; returns what it was told of."""
    done = []
    mapping = options().mapping
    tasks = [
        GroupTask(number, tmp_path / f"group-{number}.engram", [one], Settings(), mapping)
        for number, one in enumerate(sources)
    ]
    map_groups_on_cluster(tasks, started.scheduler_address, Watching(*watching), done.append)
    return done


class HeardError(Exception):
    """Raised where the build is asked to stop."""


def test_frames_are_told_while_a_group_is_mapped(scheduler, tmp_path, logs):
    words = []
    (tmp_path / "group-0.engram-wal").write_bytes(b"left by a worker of this machine")

    def advance(word):
        words.append((word, (tmp_path / "group-0.engram").exists()))

    (result,) = run(scheduler, tmp_path, [logs["a"]], advance)
    assert len(words) == result.sessions[0]["frames"] == 20
    assert [there for _, there in words[:10]] == [False] * 10  # before the group was done
    assert check_file(tmp_path / "group-0.engram").problems == ()


def test_ctrl_c_is_heard_within_a_group_and_the_worker_stops(
    scheduler, tmp_path, logs, monkeypatch
):
    asked, mapped = [], []
    given_up, may_go_on = threading.Event(), threading.Event()
    really = cluster.map_group_far_away

    def slow(task, monitor):
        def held(word):
            mapped.append(word)
            if len(mapped) > _WORDS_AT_ONCE:  # the client was told of those before
                may_go_on.wait()  # until it is gone
            monitor.advance(word)

        try:
            return really(task, Watching(held))
        except cluster._GivenUpError:
            given_up.set()
            raise

    def check():
        if asked:
            raise HeardError

    monkeypatch.setattr(cluster, "map_group_far_away", slow)
    with pytest.raises(HeardError):
        run(scheduler, tmp_path, [logs["a"]], asked.append, check)
    (worker,) = scheduler.workers.values()
    states = worker.state.tasks
    while any(one.state == "executing" for one in list(states.values())):
        may_go_on.wait(0.01)  # the scheduler tells the worker in its own time
    may_go_on.set()
    assert given_up.wait(60)
    assert not list(tmp_path.iterdir())


def test_a_drive_that_cannot_be_read_is_tried_once(scheduler, tmp_path, monkeypatch):
    tried = []
    really = cluster.map_group_far_away

    def counted(task, monitor):
        tried.append(task.number)
        return really(task, monitor)

    monkeypatch.setattr(cluster, "map_group_far_away", counted)
    with pytest.raises(SequenceError, match="nowhere"):
        run(scheduler, tmp_path, [str(tmp_path / "nowhere.framelog")])
    assert tried == [0]


def test_a_scheduler_that_is_lost_is_told(scheduler, tmp_path, logs, monkeypatch):
    monkeypatch.setattr(cluster, "_CONNECT_S", 1)
    closing = []

    def close(_):
        if not closing:
            closing.append(scheduler.loop.add_callback(scheduler.scheduler.close))

    with pytest.raises(WorkerError, match="was lost, and group 0 with it"):
        run(scheduler, tmp_path, [logs["a"]], close)


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("nonsense", "'nonsense' is not a valid scheduler address"),
        ("carrier-pigeon://10.0.0.5:8786", "is not a valid scheduler address"),
        ("tcp://127.0.0.1:1", "does not answer"),
    ],
)
def test_a_scheduler_that_cannot_be_is_told_before_anything_is_begun(
    tmp_path, logs, monkeypatch, address, says
):
    made = []
    monkeypatch.setattr(cluster, "_CONNECT_S", 1)
    monkeypatch.setattr(distributed.Client, "__init__", lambda *_, **__: made.append(address))
    with pytest.raises(WorkerError, match=says):
        build(tmp_path / "centre.engram", logs, "a", groups=1, scheduler=address)
    assert made == []
    assert not (tmp_path / "centre.engram.build").exists()


def test_what_dask_raises_is_told_as_an_error_of_workers():
    failed: Future[None] = Future()
    failed.set_exception(distributed.KilledWorker("task", SimpleNamespace(address="worker"), 3))
    with pytest.raises(WorkerError, match=r"group 7 was not done .* KilledWorker"):
        cluster._outcome(failed, "group 7", "tcp://nowhere:1")
