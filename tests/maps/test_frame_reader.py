"""Frames read lazily: from any thread, within a bound of memory, ahead of being asked for."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from engram.errors import InputError
from engram.graph.model import NodeId
from engram.maps.map import Map

from .frames import assert_same_landmarks
from .maps import begin, session, write_drive


@pytest.fixture
def drive_and_path(tmp_path):
    path = tmp_path / "town.engram"
    with Map.create(path) as store:
        writer = begin(store, session())
        drive = write_drive(writer, 30)
        writer.commit()
    return drive, path


def cached(store: Map, ids: list[NodeId]) -> int:
    """How many of these come back as the very same object."""
    return sum(store.frames.frame(one) is store.frames.frame(one) for one in ids)


def test_the_cache_is_bounded_and_keeps_what_was_used_last(drive_and_path):
    drive, path = drive_and_path
    ids = [node.id for node in drive.nodes]
    # One frame of 20 landmarks counts as 1500 + 20 · 61 bytes: five fit.
    with Map.open(path, cache_bytes=5 * (1500 + 20 * 61)) as store:
        first = [store.frames.frame(one) for one in ids[:5]]
        store.frames.frame(ids[0])
        store.frames.frame(ids[5])
        assert store.frames.frame(ids[0]) is first[0]
        assert store.frames.frame(ids[1]) is not first[1]
    with Map.open(path) as store:
        assert cached(store, ids) == len(ids)


def test_a_cache_smaller_than_a_frame_still_reads(drive_and_path):
    drive, path = drive_and_path
    with Map.open(path, cache_bytes=0) as store:
        for node in drive.nodes:
            found = store.frames.frame(node.id)
            assert_same_landmarks(found.landmarks, drive.frames[node.id].landmarks)


def test_frames_are_read_from_many_threads(drive_and_path):
    drive, path = drive_and_path
    ids = [node.id for node in drive.nodes] * 4
    with Map.open(path, cache_bytes=10_000) as store, ThreadPoolExecutor(8) as pool:
        for one, found in zip(ids, pool.map(store.frames.frame, ids), strict=True):
            assert_same_landmarks(found.landmarks, drive.frames[one].landmarks)


def test_prefetched_frames_are_there_when_asked_for(drive_and_path, monkeypatch):
    drive, path = drive_and_path
    ids = [node.id for node in drive.nodes]
    with Map.open(path) as store:
        read_by: dict[NodeId, str] = {}
        all_read = threading.Event()
        remember = store.frames._remember

        def note(node, frame):
            remember(node, frame)
            read_by[node] = threading.current_thread().name
            if len(read_by) == len(ids):
                all_read.set()

        monkeypatch.setattr(store.frames, "_remember", note)
        store.frames.prefetch([NodeId(session().id), *ids])  # the first is unknown: only a hint
        assert all_read.wait(60)
        for one in ids:
            store.frames.frame(one)
        assert set(read_by.values()) == {"engram-read-ahead"}


def test_an_unknown_node_is_a_clear_error(drive_and_path):
    with (
        Map.open(drive_and_path[1]) as store,
        pytest.raises(InputError, match="no node"),
    ):
        store.frames.frame(NodeId(session().id))


def test_a_writer_reads_while_it_checkpoints(tmp_path):
    with Map.create(tmp_path / "town.engram") as store:
        writer = begin(store, session())
        drive = write_drive(writer, 10)
        ids = [node.id for node in drive.nodes]
        with ThreadPoolExecutor(4) as pool:
            found = [pool.submit(store.frames.frame, one) for one in ids * 5]
            writer.checkpoint()
            for one, frame in zip(ids * 5, found, strict=True):
                assert_same_landmarks(frame.result().landmarks, drive.frames[one].landmarks)
