"""kill -9 at any moment: the map opens without repair and lost nothing that was checkpointed."""

from __future__ import annotations

import random
import select
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from engram.errors import MapLockedError
from engram.maps.map import Map
from engram.maps.map_files import check_file, copy_map

from .frames import assert_same_landmarks
from .maps import begin, node, node_frame, session, write_drive

SESSIONS, NODES = 3, 9


def run_and_kill(path: Path, rng: random.Random, *, in_commit: bool) -> tuple[str, int, int]:
    """Kill the writer at a random moment; returns the last thing it said it had done."""
    writer = subprocess.Popen(
        [sys.executable, "-m", "tests.maps.crashing_writer", path, str(SESSIONS), str(NODES)],
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parents[2],
        text=True,
    )
    assert writer.stdout is not None
    heard = ("nothing", 0, 0)
    lines = rng.randrange(1, 8)
    while lines and (line := writer.stdout.readline()):
        verb, number, count = line.split()
        heard = (verb, int(number), int(count))
        lines -= 1
        if in_commit:
            lines = 0 if verb == "committing" else 1
    # Whatever comes next, kill within it: a checkpoint takes about five milliseconds.
    select.select([], [], [], rng.uniform(0, 0.006))
    writer.kill()
    for line in writer.communicate()[0].splitlines():
        verb, number, count = line.split()
        heard = (verb, int(number), int(count))
    return heard


def assert_as_said(path: Path, heard: tuple[str, int, int]) -> None:
    """The map holds all that was said to be checkpointed, and at most the batch in flight more."""
    verb, number, count = heard
    with Map.open(path) as store:
        contents = store.load()
        interrupted = store.interrupted()
        per_session = {one.id: 0 for one in contents.sessions}
        for one in contents.nodes:
            per_session[one.session] += 1
            index = (one.stamp_ns - session().start_ns) // 50_000_000
            assert one == node(next(s for s in contents.sessions if s.id == one.session), index)
            assert_same_landmarks(
                store.frames.frame(one.id).landmarks,
                node_frame(session(), index).landmarks,
            )
    assert set(per_session.values()) <= {NODES}
    committed = len(per_session)
    if verb == "committed":
        assert committed == number + 1
    elif verb != "done":
        assert committed in {number, number + (verb == "committing")}
    assert len(interrupted) <= 1
    if verb in {"checkpointed", "checkpointing"}:
        (one,) = interrupted
        assert one.nodes in {count, count - 3 * (verb == "checkpointing")}
    if verb == "committing" and committed == number:
        assert interrupted[0].nodes == NODES
    report = check_file(path)
    assert report.problems == ()
    assert report.interrupted == tuple(one.session.id for one in interrupted)


def kill_and_resume(path: Path, seed: int, kills: int) -> None:
    rng = random.Random(seed)
    Map.create(path).close()
    for kill in range(kills):
        heard = run_and_kill(path, rng, in_commit=kill % 3 == 2)
        assert_as_said(path, heard)
        if heard[0] == "done":
            path.unlink()
            Map.create(path).close()
        elif kill % 4 == 3:
            with Map.open(path, writes=True) as store:
                for one in store.interrupted():
                    store.resume_session(one.session.id).abandon()
    with Map.open(path, writes=True) as store:
        for one in store.interrupted():
            assert store.seal(one.session.id).number == store.revision
    assert check_file(path).problems == ()


def test_killed_at_any_moment_the_map_holds_what_was_checkpointed(tmp_path):
    kill_and_resume(tmp_path / "town.engram", seed=1, kills=4)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2, 6))
def test_killed_many_times_the_map_holds_what_was_checkpointed(tmp_path, seed):
    kill_and_resume(tmp_path / "town.engram", seed, kills=30)


def test_a_map_made_where_another_was_removed_takes_nothing_of_its_log(tmp_path):
    """A killed writer leaves its log; people remove the map and overlook what lies beside it."""
    path, aside = tmp_path / "town.engram", tmp_path / "aside"
    with Map.create(path) as store:
        writer = begin(store, session())
        write_drive(writer)
        writer.checkpoint()
        log = path.with_name("town.engram-wal")
        shutil.copy(log, aside)  # as it is now, for closing empties it
    other = tmp_path / "other.engram"
    Map.create(other).close()
    for make in (lambda: Map.create(path).close(), lambda: copy_map(other, path)):
        path.unlink()
        shutil.copy(aside, log)
        make()
        assert check_file(path).problems == ()
        with Map.open(path) as store:
            assert store.interrupted() == []


def test_a_log_whose_writer_is_alive_is_not_removed(tmp_path):
    path = tmp_path / "town.engram"
    with Map.create(path):
        path.unlink()
        with pytest.raises(MapLockedError):
            Map.create(path)
        assert path.with_name("town.engram-wal").exists()
