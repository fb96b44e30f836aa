"""What a map does."""

from __future__ import annotations

import dataclasses
import os

import numpy as np
import pytest
from sqlalchemy import insert
from tests.builders import attempts_of

from engram.errors import IncompatibleError, InputError, MapError, MapLockedError, RevisionError
from engram.frontend.frame import BRIEF
from engram.geometry.cameras import StereoCamera
from engram.graph.model import EdgeKind, NodeId, PathEntry, PathEntryKind, path_id
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.records import SessionState
from engram.maps.rows import sealed
from engram.maps.schema import hidden
from engram_lab.teblid import TEBLID

from .frames import CAMERA, assert_same_landmarks
from .maps import (
    Drive,
    assert_same_edges,
    attempt,
    begin,
    edge,
    node,
    node_frame,
    session,
    write_drive,
)


@pytest.fixture
def store(location):
    with Map.create(location) as store:
        yield store


def assert_holds(store: Map, *drives: Drive) -> None:
    contents = store.load()
    assert contents.sessions == tuple(drive.session for drive in drives)
    assert contents.nodes == tuple(node for drive in drives for node in drive.nodes)
    assert_same_edges(contents.edges, [edge for drive in drives for edge in drive.edges])
    assert contents.path_entries == tuple(entry for drive in drives for entry in drive.entries)
    for drive in drives:
        read = attempts_of(contents, drive.session.id)
        assert [(a.iteration, a.node, a.rank) for a in read] == [
            (a.iteration, a.node, a.rank) for a in drive.attempts
        ]
        for id_, frame in drive.frames.items():
            found = store.frames.frame(id_)
            assert_same_landmarks(found.landmarks, frame.landmarks)
            for name in ("stamp_ns", "camera", "descriptor", "frontend", "status"):
                assert getattr(found, name) == getattr(frame, name)


class TestSessions:
    def test_a_new_map_is_empty(self, store):
        contents = store.load()
        assert (contents.sessions, contents.nodes, list(contents.edges)) == ((), (), [])
        assert len(contents.attempts) == 0
        assert store.log() == []
        assert store.revision == 0
        assert store.info().descriptor is None

    def test_a_committed_session_is_read_back(self, store, location):
        writer = begin(store, session())
        drive = write_drive(writer)
        revision = writer.commit()
        assert revision.number == 1
        assert revision.parent is None
        assert revision.configuration == {"mapper": {"distance_m": 1.0}}
        assert_holds(store, drive)
        with Map.open(location) as reader:
            assert_holds(reader, drive)
            assert reader.log() == [revision]

    def test_readers_see_a_session_only_after_its_commit(self, store, location):
        writer = begin(store, session())
        drive = write_drive(writer)
        writer.checkpoint()
        with Map.open(location) as reader:
            assert reader.load().nodes == ()
            with pytest.raises(InputError, match="not part of the map"):
                reader.frames.frame(drive.nodes[0].id)
            writer.commit()
            assert reader.load().nodes == ()
        with Map.open(location) as reader:
            assert_holds(reader, drive)

    def test_a_writer_reads_its_own_frames_before_the_checkpoint(self, store):
        drive = write_drive(begin(store, session()))
        found = store.frames.frame(drive.nodes[2].id)
        assert_same_landmarks(found.landmarks, drive.frames[drive.nodes[2].id].landmarks)

    def test_the_same_session_twice_is_refused_and_changes_nothing(self, store):
        writer = begin(store, session())
        drive = write_drive(writer)
        assert store.session_state(session().id) is SessionState.OPEN
        writer.commit()
        assert store.session_state(session().id) is SessionState.COMMITTED
        with pytest.raises(RevisionError, match="holds this drive already: session"):
            begin(store, session())
        assert_holds(store, drive)
        assert store.revision == 1

    def test_an_abandoned_session_leaves_no_trace_and_may_come_again(self, store):
        writer = begin(store, session())
        write_drive(writer)
        writer.checkpoint()
        writer.abandon()
        assert store.load().nodes == ()
        assert store.session_state(session().id) is SessionState.ABSENT
        with pytest.raises(RevisionError, match="abandoned"):
            writer.checkpoint()
        again = begin(store, session())
        drive = write_drive(again)
        again.commit()
        assert_holds(store, drive)

    def test_one_session_at_a_time(self, store):
        begin(store, session())
        with pytest.raises(RevisionError, match="being written"):
            begin(store, session("robot-2"))

    def test_a_second_kind_of_descriptor_is_refused(self, store):
        writer = begin(store, session())
        write_drive(writer)
        writer.commit()
        with pytest.raises(IncompatibleError, match=r"brief.*teblid"):
            begin(store, session("robot-2"), descriptor=TEBLID)
        assert store.info().descriptor == BRIEF


class TestInterruption:
    def test_a_session_without_its_writer_is_interrupted_and_resumes(self, store, location):
        writer = begin(store, session())
        drive = write_drive(writer)
        writer.checkpoint()
        lost = node(session(), 9)
        writer.add_node(lost, node_frame(session(), 9))
        store.close()
        with Map.open(location) as reader:
            (found,) = reader.interrupted()
            assert found.session == session()
            assert (found.nodes, found.last_stamp_ns) == (5, drive.nodes[-1].stamp_ns)
        with Map.open(location, writes=True) as again:
            assert again.session_state(session().id) is SessionState.INTERRUPTED
            with pytest.raises(RevisionError, match="holds this drive, interrupted"):
                begin(again, session())
            resumed = again.resume_session(session().id)
            assert resumed.stored.nodes == tuple(drive.nodes)
            assert resumed.stored.last_stamp_ns == drive.nodes[-1].stamp_ns
            assert resumed.stored.next_sequence == 5
            assert resumed.stored.next_iteration == 5
            drive.write_node(resumed, 5)
            resumed.commit()
            assert again.interrupted() == []
            assert_holds(again, drive)

    def test_an_interrupted_session_can_be_sealed(self, store, location):
        writer = begin(store, session())
        drive = write_drive(writer)
        writer.checkpoint()
        store.close()
        with Map.open(location, writes=True) as again:
            assert again.seal(session().id).number == 1
            assert_holds(again, drive)
            with pytest.raises(RevisionError, match="no interrupted session"):
                again.seal(session().id)

    def test_a_live_writer_is_not_interrupted(self, store, location):
        begin(store, session())
        with Map.open(location) as reader:
            assert reader.interrupted() == []
            assert reader.session_state(session().id) is SessionState.OPEN

    def test_the_second_writer_learns_who_the_first_is(self, store, location):
        with pytest.raises(MapLockedError, match=f"process {os.getpid()} on "):
            Map.open(location, writes=True)


class TestRecords:
    def test_a_newer_edge_takes_the_place_of_an_older_one(self, store, location):
        writer = begin(store, session())
        drive = write_drive(writer, 2)
        a, b = drive.nodes[0].id, drive.nodes[1].id
        writer.add_edge(edge(a, b, EdgeKind.PROXIMITY, seed=7))
        writer.checkpoint()
        writer.add_edge(edge(a, b, EdgeKind.PROXIMITY, seed=8))
        writer.add_edge(edge(a, b, EdgeKind.PROXIMITY, seed=9))
        writer.commit()
        assert_same_edges(
            store.load().edges, [*drive.edges, edge(a, b, EdgeKind.PROXIMITY, seed=9)]
        )
        later = begin(store, session("robot-2"))
        later.add_edge(edge(a, b, EdgeKind.PROXIMITY, seed=10))
        later.commit()
        with Map.open(location, at=1) as old, Map.open(location, at=2) as new:
            assert_same_edges([old.load().edges[-1]], [edge(a, b, EdgeKind.PROXIMITY, seed=9)])
            assert_same_edges([new.load().edges[-1]], [edge(a, b, EdgeKind.PROXIMITY, seed=10)])
            assert len(new.load().edges) == 2

    def test_what_does_not_fit_is_refused(self, store):
        drive = session()
        writer = begin(store, drive)
        good, frame = node(drive, 0), node_frame(drive, 0)
        other = dataclasses.replace(
            frame, camera=StereoCamera(200.0, 200.0, 255.0, 191.0, 0.5, 512, 384)
        )
        stranger = NodeId(session().id)
        for wrong, its_frame, error in (
            (dataclasses.replace(good, session=session("x").id), frame, InputError),
            (dataclasses.replace(good, stamp_ns=7), frame, InputError),
            (dataclasses.replace(good, driven_m=np.nan), frame, InputError),
            (dataclasses.replace(good, camera=other.camera.id), other, InputError),
            (good, dataclasses.replace(frame, frontend="other"), IncompatibleError),
            (good, dataclasses.replace(frame, descriptor=TEBLID), IncompatibleError),
        ):
            with pytest.raises(error):
                writer.add_node(wrong, its_frame)
        writer.add_node(good, frame)
        with pytest.raises(InputError, match="already"):
            writer.add_node(good, frame)
        with pytest.raises(InputError, match="not in the map"):
            writer.add_edge(edge(good.id, stranger))
        with pytest.raises(InputError, match="itself"):
            writer.add_edge(edge(good.id, good.id))
        lopsided = edge(good.id, stranger)
        lopsided.covariance[0, 1] += 1
        with pytest.raises(InputError, match="symmetric"):
            writer.add_edge(lopsided)
        with pytest.raises(InputError, match="not in the map"):
            writer.add_attempts([attempt(0, good.id, stranger)])
        entry = PathEntry(path_id(drive.id), 3, good.id, PathEntryKind.SAVED, 0)
        writer.add_path_entry(entry)
        with pytest.raises(InputError, match="already"):
            writer.add_path_entry(entry)
        writer.commit()
        assert store.load().nodes == (good,)

    @pytest.mark.parametrize(
        "changes", [{"author": "\udcff"}, {"message": "a\0b"}, {"configuration": {"x": np.nan}}]
    )
    def test_what_no_database_can_keep_is_refused(self, store, changes):
        with pytest.raises(InputError):
            begin(store, session(), **changes)
        with pytest.raises(InputError, match="64 bits"):
            begin(store, session(start_ns=2**63))
        assert store.session_state(session().id) is SessionState.ABSENT

    def test_thumbnails_are_read_apart(self, store, location):
        writer = begin(store, session())
        drive = write_drive(writer, 1)
        writer.commit()
        with Map.open(location) as reader:
            assert reader.frames.frame(drive.nodes[0].id).thumbnail is None
            assert reader.frames.thumbnail(drive.nodes[0].id).shape == (30, 40)

    def test_the_camera_comes_back_to_the_last_bit(self, store):
        begin(store, session()).commit()
        assert store.load().cameras == {CAMERA.id: CAMERA}


class TestHistory:
    def test_every_revision_can_be_read_back(self, store, location):
        drives = []
        for number in range(3):
            writer = begin(store, session(f"robot-{number}"))
            drives.append(write_drive(writer, 2 + number))
            writer.commit()
        for at in range(4):
            with Map.open(location, at=at) as old:
                assert_holds(old, *drives[:at])
                assert [one.number for one in old.log()] == list(range(1, at + 1))
                assert old.info().nodes == sum(len(drive.nodes) for drive in drives[:at])
        for at in (-1, 4):
            with pytest.raises(RevisionError, match="1 to 3"):
                Map.open(location, at=at)

    def test_a_session_committed_late_does_not_change_older_revisions(self, store, location):
        first = begin(store, session("interrupted"))
        early = write_drive(first)
        first.checkpoint()
        store.close()
        with Map.open(location, writes=True) as again:
            second = begin(again, session("quick"))
            late = write_drive(second)
            second.commit()
            assert_holds(again, late)
            again.seal(session("interrupted").id)
            assert_holds(again, late, early)
        with Map.open(location, at=1) as old:
            assert_holds(old, late)


class TestHidden:
    """`revert` will hide rows; what readers make of hidden rows stands already."""

    def hide(self, store: Map, name: str, record: str, target: int, hide: int) -> None:
        """A new revision with one `hidden` row."""
        writer = begin(store, session(name))
        row = {
            "key": store._keys.next(hidden),
            "revision": writer._revision_key,
            "record": record,
            "target": target,
            "hidden": hide,
        }
        with store._database.writing() as connection:
            connection.execute(insert(hidden), [sealed(hidden, row)])
        writer.commit()

    def test_a_hidden_node_takes_along_what_refers_to_it_and_may_come_back(self, store, location):
        writer = begin(store, session())
        drive = write_drive(writer)
        writer.commit()
        self.hide(store, "hides", "nodes", target=3, hide=1)
        gone = drive.nodes[2].id
        contents = store.load()
        assert contents.nodes == tuple(one for one in drive.nodes if one.id != gone)
        assert_same_edges(contents.edges, [e for e in drive.edges if gone not in {e.a, e.b}])
        assert [e.sequence for e in contents.path_entries] == [0, 1, 3, 4]
        assert {a.iteration for a in attempts_of(contents, session().id)} == {1, 4}
        info = store.info()
        assert (info.nodes, info.edges, info.path_entries) == (4, 2, 4)
        with Map.open(location) as reader, pytest.raises(InputError, match="not part"):
            reader.frames.frame(gone)
        self.hide(store, "shows", "nodes", target=3, hide=0)
        assert store.load().nodes == tuple(drive.nodes)
        with Map.open(location) as reader, Map.open(location, at=2) as older:
            assert_same_landmarks(reader.frames.frame(gone).landmarks, drive.frames[gone].landmarks)
            assert len(older.load().nodes) == 4
        assert check_file(location).problems == ()

    def test_a_hidden_edge_shows_the_one_it_superseded(self, store):
        writer = begin(store, session())
        drive = write_drive(writer, 2)
        writer.commit()
        ends = (drive.nodes[0].id, drive.nodes[1].id)
        writer = begin(store, session("robot-2"))
        writer.add_edge(edge(*ends, seed=5))
        writer.commit()
        assert_same_edges(store.load().edges, [edge(*ends, seed=5)])
        self.hide(store, "hides", "edges", target=2, hide=1)
        assert_same_edges(store.load().edges, drive.edges)


class TestContentHash:
    def test_equal_maps_have_equal_hashes_however_they_were_checkpointed(self, store, tmp_path):
        writer = begin(store, session())
        drive = write_drive(writer)
        writer.add_edge(edge(drive.nodes[0].id, drive.nodes[4].id, EdgeKind.PROXIMITY, seed=1))
        writer.commit()
        with Map.create(tmp_path / "other.engram") as other:
            gone = begin(other, session("gone"))
            write_drive(gone)
            gone.checkpoint()
            gone.abandon()
            writer = begin(other, session())
            again = Drive(session())
            for index in range(5):
                again.write_node(writer, index)
                writer.checkpoint()
                if index == 4:
                    ends = (again.nodes[0].id, again.nodes[4].id)
                    writer.add_edge(edge(*ends, EdgeKind.PROXIMITY, seed=5))
                    writer.checkpoint()
                    writer.add_edge(edge(*ends, EdgeKind.PROXIMITY, seed=1))
            writer.commit()
            assert other.content_hash() == store.content_hash()

    def test_any_other_content_has_another_hash(self, store, location, tmp_path):
        writer = begin(store, session())
        write_drive(writer)
        writer.commit()
        hashes = {store.content_hash()}
        for number, changes in enumerate(
            ({}, {"count": 4}, {"author": "else"}, {"more": 1}, {"name": "x"})
        ):
            with Map.create(tmp_path / f"{number}.engram") as other:
                drive = session(changes.get("name", "robot-1"))
                writer = begin(other, drive, author=changes.get("author", "tests"))
                written = write_drive(writer, changes.get("count", 5))
                if "more" in changes:
                    first = written.nodes[0].id
                    writer.add_attempts([attempt(9, first, first)])
                writer.commit()
                hashes.add(other.content_hash())
        assert len(hashes) == 5

    def test_hashes_of_records_do_not_tell_who_wrote_them_or_how(self, store, tmp_path):
        writer = begin(store, session())
        write_drive(writer)
        writer.commit()
        found = store.record_hashes()
        assert set(found) == {"sessions", "nodes", "edges", "paths", "path_entries", "attempts"}
        for number, (author, count) in enumerate([("else", 5), ("tests", 4)]):
            with Map.create(tmp_path / f"{number}.engram") as other:
                writer = begin(other, session(), author=author, configuration={"a": number})
                write_drive(writer, count)
                writer.commit()
                same = {name for name, one in other.record_hashes().items() if one == found[name]}
                assert same == (set(found) if count == 5 else {"sessions", "paths"})
                assert other.content_hash() != store.content_hash()

    def test_the_hash_of_an_old_revision_stays(self, store, location):
        writer = begin(store, session())
        write_drive(writer)
        writer.commit()
        before = store.content_hash()
        writer = begin(store, session("robot-2"))
        write_drive(writer)
        writer.checkpoint()
        assert store.content_hash() == before
        writer.commit()
        assert store.content_hash() != before
        with Map.open(location, at=1) as old:
            assert old.content_hash() == before


class TestCheck:
    def test_a_sound_map_has_no_problems(self, store, location):
        writer = begin(store, session())
        write_drive(writer)
        writer.commit()
        writer = begin(store, session("robot-2"))
        write_drive(writer)
        writer.checkpoint()
        report = check_file(location)
        assert report.problems == ()
        assert report.interrupted == ()
        # Two sessions with five nodes each: landmarks, thumbnails, a body of attempts.
        assert report.blobs == 2 * (5 + 5 + 1)
        store.close()
        assert check_file(location).interrupted == (session("robot-2").id,)

    def test_rows_of_abandoned_sessions_are_counted_and_cleaned(self, store, location):
        writer = begin(store, session())
        write_drive(writer)
        writer.checkpoint()
        writer.abandon()
        assert check_file(location).abandoned_rows == 1 + 5 + 5 + 4 + 1 + 5 + 1
        assert store.clean() == 22
        report = check_file(location)
        assert report.abandoned_rows == 0
        assert report.sound


@pytest.mark.parametrize(
    "asked",
    [
        lambda store, _: store.robot(CAMERA),
        lambda store, _: store.robot(CAMERA, name="r1", maps=True),
        lambda store, _: store.graph,
        lambda store, _: store.log(),
        lambda store, _: store.info(),
        lambda store, _: store.load(),
        lambda store, node: store.frames.frame(node),
        lambda store, _: store.check(),
        lambda store, _: store.begin_revision(author="me", message="", configuration={}),
        lambda store, _: store.tag("first", author="me"),
        lambda store, _: store.clean(),
    ],
)
@pytest.mark.parametrize("writes", [False, True])
def test_a_closed_map_refuses_whatever_needs_its_file(store, location, asked, writes):
    writer = begin(store, session("r1"))
    node = write_drive(writer, 2).nodes[0].id
    writer.commit()
    store.close()
    closed = Map.open(location, writes=writes)
    assert len(closed.graph) == 2  # known before it is closed
    closed.close()
    closed.close()
    with pytest.raises(MapError, match=r"town\.engram is closed: open the map again"):
        asked(closed, node)
    with Map.open(location, writes=True):
        pass  # it holds no lock
