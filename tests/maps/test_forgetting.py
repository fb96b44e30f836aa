"""Forgetting: hidden first, then erased; history verifies throughout, and nothing comes back."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing, suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engram.errors import InputError, MapLockedError, RevisionError
from engram.geometry.se3 import SE3
from engram.graph.model import EdgeKind, Omission, PathEntry, PathEntryKind, path_id
from engram.maps.forgetting import Chosen, erase_map
from engram.maps.map import Map
from engram.maps.map_files import check_file

from .data.make_map import OMITTED
from .maps import Drive, attempt, begin, edge, session, write_drive


def write_town(path: Path, drives: int = 3, nodes: int = 3, longest: int = 3) -> list[Drive]:
    """Drives that hang on each other: each has an edge to the one before, passes its nodes, and
    tried them. The second one has `longest` nodes."""
    written: list[Drive] = []
    with Map.create(path) as store:
        for number in range(drives):
            writer = begin(store, session(f"robot-{number}"))
            drive = write_drive(writer, longest if number == 1 else nodes)
            if written:
                before = written[-1].nodes
                writer.add_edge(edge(before[-1].id, drive.nodes[0].id, EdgeKind.MATCH, seed=number))
                for at, one in enumerate(before):
                    passed = PathEntry(
                        path_id(drive.session.id), 10 + at, one.id, PathEntryKind.MATCHED, at
                    )
                    writer.add_path_entry(passed)
                    writer.add_attempts([attempt(50 + at, drive.nodes[0].id, one.id)])
            written.append(drive)
            writer.commit()
    return written


def forget(path: Path, *drives: Drive, pictures: bool = False, **options: object) -> object:
    with Map.open(path) as store:
        chosen = Chosen(frozenset(one.session.id for one in drives), pictures=pictures)
        return store.forget_nodes(
            chosen, author="tests", message="forget: a test", configuration={}, **options
        )


def hashes(path: Path) -> list[str]:
    with Map.open(path) as store:
        last = store.revision
    found = []
    for at in range(1, last + 1):
        with Map.open(path, at=at) as store:
            assert store.verified_hash() == store.content_hash()
            found.append(store.content_hash())
    return found


def test_what_is_forgotten_is_hidden_and_a_revert_shows_it_again(location: Path) -> None:
    town = write_town(location)
    preview = forget(location, town[1], dry_run=True)
    assert preview.revision is None
    done = forget(location, town[1])
    assert (done.revision, done.sessions, done.nodes) == (4, 1, 3)
    assert done.edges == 4  # two of its own, one to each neighbour
    assert done.path_entries == 9  # its own six, and three by which the next one passed
    assert done.components == (1, 2)
    assert done.size_bytes == preview.size_bytes > 0
    with Map.open(location) as store:
        assert {one.session for one in store.load().nodes} == {
            town[0].session.id, town[2].session.id,
        }  # fmt: skip
        assert town[1].session.id not in store.sessions
        gone, kept = town[1].session.id, town[0].session.id
        assert store.lookups.forgotten([gone, kept]) == {gone}
        assert store.lookups.known([gone.bytes, kept.bytes]) == {gone.bytes}
    assert check_file(location).problems == ()
    with Map.open(location) as store:
        before = Map.open(location, at=3).load()
        store.revert("head", author="tests")
        assert store.load().nodes == before.nodes
        assert store.load().path_entries == before.path_entries
        assert store.lookups.forgotten([town[1].session.id]) == frozenset()
    assert check_file(location).problems == ()


def test_erased_rows_are_not_in_the_file_and_every_hash_stays(location: Path) -> None:
    town = write_town(location, longest=5)
    with closing(sqlite3.connect(location)) as connection:
        # Of the two frames that only the second drive has: others are alike.
        rows = connection.execute("SELECT landmarks FROM frames WHERE node IN (7, 8)")
        secrets = [b"robot-1", *(blob[-100:] for (blob,) in rows)]
    forget(location, town[1])
    before = hashes(location)
    assert all(one in location.read_bytes() for one in secrets)
    done = erase_map(location)
    assert (done.rows["sessions"], done.rows["nodes"], done.rows["frames"]) == (1, 5, 5)
    assert done.rows["edges"] == 6
    assert done.after_bytes < done.before_bytes
    assert hashes(location) == before
    assert check_file(location).problems == ()
    assert check_file(location, since=1).problems == ()
    left = b"".join(one.read_bytes() for one in location.parent.iterdir())
    assert [one for one in secrets if one in left] == []
    with Map.open(location) as store:
        assert store.lookups.forgotten([town[1].session.id])
        assert len(store.load().nodes) == 6
    assert erase_map(location).rows == {}


def test_nothing_brings_back_what_was_forgotten(location: Path) -> None:
    town = write_town(location)
    forget(location, town[1])
    for erased in (False, True):
        if erased:
            erase_map(location)
            with (
                Map.open(location) as store,
                pytest.raises(RevisionError, match="since been erased"),
            ):
                store.revert(4, author="tests")
        with Map.open(location, writes=True) as store:
            with pytest.raises(InputError, match=r"was forgotten .* not added again"):
                begin(store, town[1].session)
            writer = begin(store, session(f"another-{erased}"))
            write_drive(writer, 2)
            writer.commit()
            assert len(store.load().nodes) == 8 + 2 * erased
    assert check_file(location).problems == ()
    with Map.open(location) as store, pytest.raises(RevisionError, match="nothing to revert"):
        store.revert(2, author="tests")


def test_nodes_of_a_drive_go_and_their_omissions_with_them(location: Path) -> None:
    town = write_town(location)
    gone = town[1].nodes[1]
    with Map.open(location, writes=True) as store:
        with store.begin_revision(author="tests", message="", configuration={}) as writer:
            writer.add_omission(Omission(OMITTED, gone.id, SE3.identity(), bytes(16)))
            writer.commit()
        done = store.forget_nodes(
            Chosen(nodes=frozenset([gone.id])), author="t", message="", configuration={}
        )
        assert (done.sessions, done.nodes, done.components) == (0, 1, (1, 2))
        assert store.lookups.forgotten([OMITTED, gone.id]) == {OMITTED, gone.id}
        assert town[1].session.id in store.sessions
    assert erase_map(location).rows["omissions"] == 1
    assert check_file(location).problems == ()
    with Map.open(location) as store:
        assert store.omissions == {}
        assert store.lookups.forgotten([OMITTED]) == {OMITTED}


def test_pictures_alone_can_go(location: Path) -> None:
    town = write_town(location)
    done = forget(location, town[1], pictures=True)
    assert (done.nodes, done.pictures) == (0, 3)
    before = hashes(location)
    for erased in (False, True):
        if erased:
            assert erase_map(location).pictures == 3
        with Map.open(location) as store:
            for drive in town:
                for one in drive.nodes:
                    assert (store.frames.thumbnail(one.id) is None) == (drive is town[1])
                    assert len(store.frames.frame(one.id).landmarks) == 20
                (stored,) = store.frames.stored(drive.nodes[:1])
                assert (stored.thumbnail is None) == (drive is town[1])
        assert check_file(location).problems == ()
        assert hashes(location) == before
    with pytest.raises(RevisionError, match="nothing that is"):
        forget(location, town[1], pictures=True)


def test_erasing_needs_the_map_alone_and_no_interrupted_drive(location: Path) -> None:
    town = write_town(location)
    forget(location, town[1])
    with Map.open(location) as store:
        store.node_count()
        with pytest.raises(MapLockedError, match="close it there first"):
            erase_map(location)
    with Map.open(location, writes=True) as store, pytest.raises(MapLockedError):
        erase_map(location)
    with Map.open(location, writes=True) as store:
        left = begin(store, session("robot-9"))
        write_drive(left, 1)
        left.checkpoint()
    with pytest.raises(RevisionError, match="interrupted session"):
        erase_map(location)
    with Map.open(location, writes=True) as store:
        store.seal(session("robot-9").id)
    assert erase_map(location).rows["nodes"] == 3
    with closing(sqlite3.connect(location)) as connection:
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)


_KILLED = """
import os, signal, sys
from pathlib import Path
from engram.maps import forgetting
name = sys.argv[2]
stop = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)
if name == "at the end":
    forgetting.compact = lambda engine, compact=forgetting.compact: (compact(engine), stop())
else:
    setattr(forgetting, name, stop)
forgetting.erase_map(Path(sys.argv[1]))
"""


@pytest.mark.parametrize("at", ["_write_receipts", "compact", "at the end"])
def test_killed_anywhere_the_map_is_sound_and_the_command_finishes(location: Path, at: str) -> None:
    town = write_town(location)
    forget(location, town[1])
    before = hashes(location)
    ended = subprocess.run([sys.executable, "-c", _KILLED, location, at], check=False, timeout=120)
    assert ended.returncode == -signal.SIGKILL
    assert check_file(location).problems == ()
    assert hashes(location) == before
    erase_map(location)
    with closing(sqlite3.connect(location)) as connection:
        for query in ("PRAGMA freelist_count", "SELECT count(*) FROM frames WHERE node IN (4, 5)"):
            assert connection.execute(query).fetchone() == (0,)
    assert check_file(location).problems == ()
    assert os.access(location, os.W_OK)


@settings(max_examples=3)
@given(data=st.data())
def test_any_history_verifies_and_shows_what_hiding_shows(tmp_path_factory, data) -> None:
    """The model: which drives are to be seen; a map in which the others were only hidden."""
    location = tmp_path_factory.mktemp("maps") / "town.engram"
    town = write_town(location, drives=4, nodes=2)
    seen, erased, revisions = set(range(4)), set(), {}
    for _ in range(data.draw(st.integers(1, 5))):
        can = ["erase", *(["forget"] if seen else []), *(["revert"] if revisions else [])]
        match data.draw(st.sampled_from(can)):
            case "forget":
                one = data.draw(st.sampled_from(sorted(seen)))
                revisions[one] = forget(location, town[one]).revision
                seen.discard(one)
            case "revert":
                one = data.draw(st.sampled_from(sorted(revisions)))
                with Map.open(location) as store:
                    store.revert(revisions.pop(one), author="tests")
                seen.add(one)
            case _:
                before = hashes(location)
                erase_map(location)
                assert hashes(location) == before
                erased |= revisions.keys()
                revisions.clear()
    report = check_file(location)
    assert report.problems == ()
    for at in range(1, 5):  # older revisions show what is left of them
        with Map.open(location, at=at) as store:
            of = {one.session for one in store.load().nodes}
            assert of == {town[one].session.id for one in range(at) if one not in erased}
            store.lookups.attempts(list(store.sessions))
            store.pages.attempts(store.pages.part(0, store.pages.end).nodes.astype("int64"))
    hidden = location.with_name("hidden.engram")
    write_town(hidden, drives=4, nodes=2)
    for one in set(range(4)) - seen:
        forget(hidden, town[one])
    with Map.open(location) as found, Map.open(hidden) as expected:
        ours, theirs = found.load(), expected.load()
        assert ours.nodes == theirs.nodes
        assert ours.path_entries == theirs.path_entries
        assert len(ours.edges) == len(theirs.edges)
        assert len(ours.attempts) == len(theirs.attempts)
        assert found.totals().agrees(expected.totals())
        assert found.read_placements().keys() == expected.read_placements().keys()
        for one, pose in found.read_placements().items():
            assert (pose.matrix() == expected.read_placements()[one].matrix()).all()


@settings(max_examples=3)
@given(data=st.data())
def test_whatever_comes_nothing_forgotten_is_seen_and_nothing_erased_returns(
    tmp_path_factory, data
) -> None:
    location = tmp_path_factory.mktemp("maps") / "town.engram"
    town = write_town(location, nodes=2, longest=2)
    erased: set = set()
    for _ in range(data.draw(st.integers(2, 7))):
        drive = data.draw(st.sampled_from(town))
        action = data.draw(st.sampled_from(["forget", "node", "revert", "erase", "again"]))
        with suppress(RevisionError, InputError):
            if action == "forget":
                forget(location, drive)
            elif action == "erase":
                with Map.open(location) as store:
                    shown = {one.id for one in store.load().nodes} | set(store.sessions)
                    of_town = {one.session.id for one in town}
                    of_town |= {node.id for one in town for node in one.nodes}
                    gone = store.lookups.forgotten(of_town)
                before = hashes(location)
                erase_map(location)
                assert hashes(location) == before
                erased |= gone
                assert not gone & shown
            else:
                with Map.open(location, writes=True) as store:
                    if action == "node":
                        store.forget_nodes(
                            Chosen(nodes=frozenset([drive.nodes[0].id])),
                            author="tests",
                            message="",
                            configuration={},
                        )
                    elif action == "revert":
                        store.revert(data.draw(st.integers(1, store.revision)), author="tests")
                    else:
                        writer = begin(store, drive.session)
                        write_drive(writer, 2)
                        writer.commit()
        report = check_file(location)
        if report.interrupted:  # a drive without its forgotten node
            with Map.open(location, writes=True) as store:
                store.seal(report.interrupted[0])
        assert check_file(location).problems == ()
        with Map.open(location) as store:
            contents = store.load()
            seen = {one.id for one in contents.nodes} | {one.id for one in contents.sessions}
            assert store.lookups.forgotten(seen) == frozenset()
            assert not seen & erased
            assert store.totals().nodes == len(contents.nodes)
