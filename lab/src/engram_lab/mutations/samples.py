"""Sound files to change: a map with rows in every table, its log, drives, a hand-in."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engram.frontend import Frame, FrameStatus
from engram.frontend.blobs import decode_landmarks
from engram.geometry import SE3
from engram.graph.marks import Anchor, Goal, Mark, Placement, Removal
from engram.graph.model import (
    Amendable,
    Attempt,
    Clock,
    Edge,
    EdgeKind,
    Node,
    NodeId,
    Omission,
    PathEntry,
    PathEntryKind,
    Session,
    path_id,
)
from engram.maps import Map, RevisionWriter, copy_map
from engram.odometry import OdometryStatus, OdometryStep
from engram.places.vocabulary import encode_vocabulary, one_word_vocabulary
from engram.sequences import FrameLogHeader, FrameLogWriter, LoggedFrame, SequenceInfo
from engram.sequences.framelog.flight import FlightWriter
from engram.transfers import PartHash, split
from engram.transfers.manifest import Manifest
from engram_lab.synthetic_places import (
    CAMERA,
    DESCRIPTOR,
    FRONTEND,
    drive_of,
    landmark_bytes,
    node_of,
)

_LANDMARKS = 12
_NODES = 4
_COVARIANCE = np.eye(6) * 1e-4


@dataclass(frozen=True, slots=True)
class Samples:
    """Files of every kind that strangers give.

    Attributes:
        town: a map, every table of which has rows.
        logged: the same map, whose last revisions are in a log beside it.
        framelog, flight: drives.
        manifest: what the map consists of, as a robot hands it in.
        parts: its pages and blobs.
    """

    town: Path
    logged: Path
    framelog: Path
    flight: Path
    manifest: Manifest
    parts: dict[PartHash, bytes]


def make_samples(folder: Path) -> Samples:
    """Makes them in a folder."""
    town, logged = folder / "town.engram", folder / "logged.engram"
    _make_map(town)
    _make_logged(town, logged)
    framelog, flight = folder / "drive.framelog", folder / "drive.flight"
    with FrameLogWriter(framelog, _header()) as writer:
        _record(writer)
    with FlightWriter(flight, _header()) as record:
        record.add_report({"reason": "lost", "robot": "r1"}, frames=_NODES, images=_NODES)
        _record(record)
    taken = split(town)
    names = [*taken.pages, *taken.blobs]
    parts = dict(zip(names, taken.parts(names), strict=True))
    return Samples(town, logged, framelog, flight, taken.manifest, parts)


def frame_of(stamp_ns: int) -> Frame:
    """A frame of a few random landmarks with a thumbnail, by its stamp."""
    blob = landmark_bytes(np.random.default_rng(stamp_ns), None, _LANDMARKS)
    picture = np.add.outer(np.arange(24), np.arange(32)).astype(np.uint8)
    landmarks = decode_landmarks(blob, CAMERA, DESCRIPTOR)
    return Frame(stamp_ns, CAMERA, landmarks, DESCRIPTOR, FRONTEND, FrameStatus.OK, picture)


def _make_map(path: Path) -> None:
    with Map.create(path) as store:
        first = _drive(store, drive_of("r1", 1_000))
        _drive(store, drive_of("r2", 2_000_000_000))
        _drive(store, drive_of("r3", 4_000_000_000))
        with store.begin_revision(author="lab", message="marks", configuration={"a": 1}) as writer:
            for mark in _marks(first):
                writer.add_mark(mark)
            gone = node_of(drive_of("r4", 1), 1, 0.0).id
            writer.add_omission(Omission(gone, first[0], SE3.identity(), bytes(range(16))))
            writer.put_statistic("speed", {"mean": 1.5})
            writer.commit()
        words = encode_vocabulary(one_word_vocabulary(DESCRIPTOR))
        store.put_vocabulary(words, author="lab", message="words", configuration={})
        store.put_words(bytes(16), {node: np.array([3, 5, 700]) for node in first})
        session = next(iter(store.sessions))
        store.amend(session, {Amendable.ROBOT: "renamed"}, author="lab")
        store.revert(2, author="lab", message="loose camera")
        store.tag("good", 1, author="lab", message="it works")
        store.tag("best", author="lab")


def _make_logged(town: Path, path: Path) -> None:
    """A copy of the map with one more revision and tag, which only the log contains."""
    draft = path.with_name("draft.engram")
    copy_map(town, draft)
    with Map.open(draft, writes=True) as store:
        _drive(store, drive_of("r5", 6_000_000_000))
        store.tag("late", author="lab")
        for suffix in ("", "-wal"):  # before the last connection folds the log into the file
            shutil.copyfile(f"{draft}{suffix}", f"{path}{suffix}")


def _drive(store: Map, drive: Session) -> list[NodeId]:
    writer = store.begin_session(
        drive,
        CAMERA,
        descriptor=DESCRIPTOR,
        frontend=FRONTEND,
        author=drive.robot,
        configuration={"mapper": {"distance_m": 1.0}},
    )
    nodes = [node_of(drive, drive.start_ns + at * 10**8, float(at)) for at in range(_NODES)]
    for at, node in enumerate(nodes):
        writer.add_node(node, frame_of(node.stamp_ns))
        entry = PathEntry(path_id(drive.id), at, node.id, PathEntryKind.SAVED, node.stamp_ns)
        writer.add_path_entry(entry)
        if at:
            _tie(writer, nodes[at - 1], node, at)
    writer.commit()
    return [node.id for node in nodes]


def _tie(writer: RevisionWriter, before: Node, node: Node, at: int) -> None:
    step = SE3(np.eye(3), np.array([0.0, 0.0, 1.0]))
    writer.add_edge(Edge(before.id, node.id, EdgeKind.ODOMETRY, step, _COVARIANCE))
    writer.add_attempts(
        [Attempt(at, before.id, node.id, 1.0, 0.0, 0.0, 0.25, 0.01, True, 30, 1, "distance")]
    )


def _marks(nodes: list[NodeId]) -> Iterator[Mark]:
    here = SE3.identity()
    yield Removal(nodes[0], nodes[1], EdgeKind.MATCH, here, "look-alike", 5)
    yield Placement(nodes[0], here)
    yield Anchor(nodes[1], 1.0, 2.0, None, 0.5, "survey")
    yield Goal("dock", nodes[2], here)


def _header() -> FrameLogHeader:
    info = SequenceInfo("drive", "kitti", Clock.UTC, "r1", 14.4, "Europe/Prague")
    return FrameLogHeader(info, CAMERA, DESCRIPTOR, FRONTEND, "odometry", "")


def _record(writer: FrameLogWriter) -> None:
    for at in range(_NODES):
        step = (
            OdometryStep(OdometryStatus.OK, SE3.identity(), _COVARIANCE, 50)
            if at
            else OdometryStep(OdometryStatus.FIRST)
        )
        writer.append(LoggedFrame(frame_of(1_000 + at * 10**8), step), f"pair{at}")
        if isinstance(writer, FlightWriter):
            writer.add_decision({"status": "localised", "node": at})
            writer.add_images(*_images())


def _images() -> tuple[bytes, bytes]:
    import cv2

    grey = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    return (cv2.imencode(".jpg", grey)[1].tobytes(),) * 2
