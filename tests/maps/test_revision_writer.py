"""One revision with records of many sessions: whole or not at all, and copied to the byte."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import insert
from tests.builders import attempts_of

from engram.errors import IncompatibleError, InputError, RevisionError
from engram.frontend.frame import BRIEF
from engram.graph.model import NodeId, Omission, PathEntry, PathEntryKind, node_id, path_id
from engram.maps import writer as writer_module
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.records import SessionState
from engram.maps.rows import sealed
from engram.maps.schema import hidden
from engram.maps.writer import RevisionWriter
from engram_lab.teblid import TEBLID

from .copying import begin_bulk, copy_into
from .frames import CAMERA, FRONTEND, assert_same_landmarks
from .maps import assert_same_edges, begin, edge, session, write_drive


@pytest.fixture
def source(tmp_path):
    """Two drives, a vocabulary, and an interrupted session that nobody should copy."""
    path = tmp_path / "source.engram"
    with Map.create(path) as store:
        for name in ("robot-1", "robot-2"):
            writer = begin(store, session(name))
            write_drive(writer, 12)
            writer.commit()
        store.put_vocabulary(b"words", author="tests", message="", configuration={})
        write_drive(begin(store, session("robot-3")), 2)
    with Map.open(path) as store:
        yield store


@pytest.fixture
def target(location):
    with Map.create(location) as store:
        yield store


def assert_same_contents(copy: Map, source: Map) -> None:
    read, written = copy.load(), source.load()
    assert read.sessions == written.sessions
    assert read.nodes == written.nodes
    assert read.path_entries == written.path_entries
    assert_same_edges(read.edges, list(written.edges))
    for one in written.sessions:
        assert attempts_of(read, one.id) == attempts_of(written, one.id)
    assert copy.frontends == source.frontends
    assert copy.landmark_hashes == source.landmark_hashes
    assert copy.vocabulary == source.vocabulary
    for mine, theirs in zip(
        copy.frames.stored(read.nodes), source.frames.stored(written.nodes), strict=True
    ):
        assert (mine.landmarks, mine.thumbnail) == (theirs.landmarks, theirs.thumbnail)


def test_a_copy_is_equal_to_the_byte(target, location, source):
    with begin_bulk(target) as writer:
        copy_into(writer, source)
        revision = writer.commit()
    assert (revision.number, revision.contents["nodes"]) == (1, 24)
    assert_same_contents(target, source)
    with Map.open(location) as reader:
        assert_same_contents(reader, source)
    assert check_file(location).problems == ()


def test_the_content_hash_does_not_tell_in_how_many_batches_it_was_written(
    tmp_path, source, monkeypatch
):
    hashes = set()
    for number, batch_bytes in enumerate((1, 10_000, 2**30)):
        monkeypatch.setattr(writer_module, "_BATCH_BYTES", batch_bytes)
        with Map.create(tmp_path / f"{number}.engram") as store:
            with begin_bulk(store) as writer:
                copy_into(writer, source)
                writer.commit()
            hashes.add(store.content_hash())
    assert len(hashes) == 1


def test_memory_does_not_grow_with_the_revision(target, source, monkeypatch):
    monkeypatch.setattr(writer_module, "_BATCH_BYTES", 20_000)
    written = []
    plain = RevisionWriter.checkpoint
    monkeypatch.setattr(RevisionWriter, "checkpoint", lambda self: (written.append(1), plain(self)))
    with begin_bulk(target) as writer:
        copy_into(writer, source)
        assert len(written) > 3
        assert writer._rows.size_bytes <= 20_000


def test_readers_see_nothing_before_the_commit_and_the_writer_everything(target, location, source):
    before = target.content_hash()
    with begin_bulk(target) as writer:
        copy_into(writer, source)
        writer.checkpoint()
        wanted = source.load().nodes[3].id
        with Map.open(location) as reader:
            assert reader.load().nodes == ()
            assert reader.content_hash() == before
            assert reader.interrupted() == []
        found = target.frames.frame(wanted)
        assert_same_landmarks(found.landmarks, source.frames.frame(wanted).landmarks)
    assert target.load().nodes == ()
    assert target.session_state(session("robot-1").id) is SessionState.ABSENT


def test_a_decoded_frame_is_read_from_memory_until_it_is_written(target, source):
    stored = next(source.frames.stored(source.load().nodes))
    with begin_bulk(target) as writer:
        writer.add_session(session("robot-1"), CAMERA, descriptor=BRIEF, frontend=FRONTEND)
        writer.copy_node(stored, source.frames.decode(stored))
        found = target.frames.frame(stored.node.id)
    assert_same_landmarks(found.landmarks, source.frames.frame(stored.node.id).landmarks)


def test_what_was_abandoned_is_collected_and_can_be_written_again(target, location, source):
    with begin_bulk(target) as writer:
        copy_into(writer, source)
        writer.checkpoint()
    report = check_file(location)
    assert report.problems == ()
    assert report.abandoned_rows > 100
    with begin_bulk(target) as writer:
        copy_into(writer, source)
        writer.commit()
    assert_same_contents(target, source)
    assert check_file(location).abandoned_rows == 0
    with pytest.raises(RevisionError, match="committed or abandoned"):
        writer.checkpoint()


def test_a_resumed_drive_gets_no_keys_that_are_free_again(location):
    """Its revision began behind the rows of an abandoned one, which are gone by now."""
    with Map.create(location) as store:
        writer = begin(store, session("robot-1"))
        write_drive(writer, 3)
        writer.checkpoint()
        writer.abandon()
    with Map.open(location, writes=True) as store:
        begin(store, session("robot-2"))
    with Map.open(location, writes=True) as store:
        writer = store.resume_session(session("robot-2").id)
        write_drive(writer, 2)
        assert writer.commit().contents["nodes"] == 2
    assert check_file(location).problems == ()


def test_killed_before_the_commit_the_map_is_as_it_was(tmp_path, source):
    path = tmp_path / "town.engram"
    with Map.create(path) as store:
        write_drive(begin(store, session("robot-9")), 3)  # interrupted, and to stay so
        before = store.content_hash()
    script = "import sys; from tests.maps.copying import copy_and_die; copy_and_die(*sys.argv[1:])"
    ended = subprocess.run(
        [sys.executable, "-c", script, path, tmp_path / "source.engram"],
        cwd=Path(__file__).parents[2],
        check=False,
    )
    assert ended.returncode == -9
    report = check_file(path)
    assert report.problems == ()
    assert report.interrupted == (session("robot-9").id,)
    assert report.abandoned_rows > 100
    with Map.open(path, writes=True) as store:
        assert store.content_hash() == before
        assert [one.session for one in store.interrupted()] == [session("robot-9")]
        assert store.clean() == report.abandoned_rows
        with begin_bulk(store) as writer:
            copy_into(writer, source)
            writer.commit()
        assert store.seal(session("robot-9").id).number == 2


@pytest.mark.parametrize("landmark_hash", [None, bytes(range(16))])
def test_omissions_and_partial_paths_are_read_back(target, source, landmark_hash):
    omitted = node_id(session("robot-7").id, 5)
    with begin_bulk(target) as writer:
        copy_into(writer, source, partial={path_id(session("robot-2").id)})
        equivalent = source.load().nodes[2].id
        transform = edge(omitted, equivalent, seed=3).a_from_b
        writer.add_omission(Omission(omitted, equivalent, transform, landmark_hash))
        with pytest.raises(InputError, match="twice"):
            writer.add_omission(Omission(omitted, equivalent, transform))
        writer.commit()
    (found,) = target.omissions.values()
    assert (found.omitted, found.node) == (omitted, equivalent)
    assert found.landmark_hash == landmark_hash
    assert target.landmark_hashes.get(omitted) == landmark_hash
    np.testing.assert_array_equal(found.node_from_omitted.matrix(), transform.matrix())
    assert target.partial_paths == {path_id(session("robot-2").id)}


def test_paths_may_be_filled_in_any_order_and_by_several_revisions(target, source):
    contents = source.load()
    with begin_bulk(target) as writer:
        copy_into(writer, source)
        writer.commit()
    path = path_id(session("robot-1").id)
    with begin_bulk(target) as writer:
        for sequence in (2**32 + 1, 2**32):
            writer.add_path_entry(
                PathEntry(path, sequence, contents.nodes[20].id, PathEntryKind.REPLAYED, 7)
            )
        with pytest.raises(InputError, match="already"):
            writer.add_path_entry(
                PathEntry(path, 3, contents.nodes[20].id, PathEntryKind.MATCHED, 7)
            )
        writer.commit()
    found = [entry.sequence for entry in target.load().path_entries if entry.path == path]
    assert found == [*range(12), 2**32, 2**32 + 1]


def test_what_does_not_fit_is_refused_by_name(target, source):
    contents = source.load()
    stored = next(source.frames.stored(contents.nodes))
    strange = NodeId(node_id(session("nobody").id, 1))
    write_drive(begin(target, session("robot-2")), 2).nodes.clear()
    target._writing.checkpoint()
    target._writing_ended()  # as if that process had died
    with begin_bulk(target) as writer:
        with pytest.raises(InputError, match="its session"):
            writer.copy_node(stored)
        with pytest.raises(RevisionError, match="interrupted in this map"):
            copy_into(writer, source)
        writer.copy_node(stored)
        with pytest.raises(InputError, match="already"):
            writer.copy_node(stored)
        with pytest.raises(InputError, match=f"edge: node {strange}"):
            writer.add_edge(edge(stored.node.id, strange))
        with pytest.raises(IncompatibleError, match="brief"):
            writer.add_session(session("robot-5"), CAMERA, descriptor=TEBLID, frontend=FRONTEND)
        with pytest.raises(RevisionError, match="being written"):
            begin_bulk(target)


def test_what_was_hidden_is_shown_again_when_it_comes_again(target, location, source):
    with begin_bulk(target) as writer:
        copy_into(writer, source)
        writer.commit()
    drive = session("robot-2")
    hide_session(target, drive.id)
    assert drive not in target.load().sessions
    assert len(target.load().nodes) == 12
    with begin_bulk(target) as writer:
        copy_into(writer, source, only={drive.id})
        writer.commit()
    assert target.load().nodes == source.load().nodes
    assert target.load().path_entries == source.load().path_entries
    assert check_file(location).problems == ()


def hide_session(store: Map, drive) -> None:
    """A revision that hides a session, as a revert does."""
    with begin_bulk(store) as writer, store._database.reading() as connection:
        tables = {
            "sessions": f"SELECT key FROM sessions WHERE uuid = x'{drive.hex}'",
            "nodes": "SELECT n.key FROM nodes n JOIN sessions s ON s.key = n.session "
            f"WHERE s.uuid = x'{drive.hex}'",
            "paths": f"SELECT key FROM paths WHERE uuid = x'{path_id(drive).hex}'",
            "path_entries": "SELECT e.key FROM path_entries e JOIN paths p ON p.key = e.path "
            f"WHERE p.uuid = x'{path_id(drive).hex}'",
        }
        for record, query in tables.items():
            for key in connection.exec_driver_sql(query).scalars().all():
                row = {
                    "key": store._keys.next(hidden),
                    "revision": writer._revision_key,
                    "record": record,
                    "target": key,
                    "hidden": 1,
                }
                with store._database.writing() as changing:
                    changing.execute(insert(hidden), [sealed(hidden, row)])
        writer.commit()
