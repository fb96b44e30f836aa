"""A small drive to put into maps, record by record."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from engram.frontend.frame import BRIEF, Frame
from engram.geometry.se3 import SE3
from engram.graph.model import (
    Attempt,
    Clock,
    Edge,
    EdgeKind,
    Node,
    NodeId,
    PathEntry,
    PathEntryKind,
    Session,
    node_id,
    path_id,
    session_id,
)
from engram.maps.map import Map
from engram.maps.writer import RevisionWriter

from .frames import CAMERA, FRONTEND, frame


def session(name: str = "robot-1", start_ns: int = 1_000) -> Session:
    return Session(
        session_id(name, CAMERA.id, start_ns, "hash"),
        name,
        CAMERA.id,
        start_ns,
        Clock.UTC,
        longitude_deg=14.4,
        zone="Europe/Prague",
    )


def begin(store: Map, drive: Session, **changes: object) -> RevisionWriter:
    arguments = {
        "descriptor": BRIEF,
        "frontend": FRONTEND,
        "author": "tests",
        "configuration": {"mapper": {"distance_m": 1.0}},
    } | changes
    return store.begin_session(drive, CAMERA, **arguments)


def node(drive: Session, index: int) -> Node:
    stamp_ns = drive.start_ns + index * 50_000_000
    return Node(node_id(drive.id, stamp_ns), drive.id, stamp_ns, CAMERA.id, 1.25 * index)


def node_frame(drive: Session, index: int, count: int = 20) -> Frame:
    return frame(node(drive, index).stamp_ns, count=count, seed=index)


def edge(a: NodeId, b: NodeId, kind: EdgeKind = EdgeKind.ODOMETRY, seed: int = 0) -> Edge:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6))
    return Edge(a, b, kind, SE3.exp(rng.normal(size=6)), (root @ root.T + (root @ root.T).T) / 2)


def attempt(iteration: int, reference: NodeId, target: NodeId, **changes: object) -> Attempt:
    values = {
        "along_m": 1.5,
        "across_m": -0.25,
        "yaw_rad": 0.125,
        "sigma_m": 0.25,
        "sigma_yaw_rad": 0.0078125,
        "accepted": True,
        "inliers": 45,
        "rank": 1,
        "policy": "distance",
    } | changes
    return Attempt(iteration, reference, target, **values)


@dataclass(repr=False)
class Drive:
    """What a session wrote, in order: the oracle for what is read back."""

    session: Session
    nodes: list[Node] = field(default_factory=list)
    frames: dict[NodeId, Frame] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)
    entries: list[PathEntry] = field(default_factory=list)
    attempts: list[Attempt] = field(default_factory=list)

    def __repr__(self) -> str:
        return f"Drive({self.session.robot}, {len(self.nodes)} nodes)"

    def write_node(self, writer: RevisionWriter, index: int) -> None:
        """One more node with its edge, path entry and attempts."""
        one, its_frame = node(self.session, index), node_frame(self.session, index)
        writer.add_node(one, its_frame)
        self.frames[one.id] = its_frame
        if self.nodes:
            self.edges.append(edge(self.nodes[-1].id, one.id, seed=index))
            writer.add_edge(self.edges[-1])
            made = [attempt(index, self.nodes[-1].id, one.id, rank=rank) for rank in range(3)]
            writer.add_attempts(made)
            self.attempts += made
        self.nodes.append(one)
        path = path_id(self.session.id)
        entry = PathEntry(path, index, one.id, PathEntryKind.SAVED, one.stamp_ns)
        writer.add_path_entry(entry)
        self.entries.append(entry)


def write_drive(writer: RevisionWriter, count: int = 5) -> Drive:
    drive = Drive(writer.session)
    for index in range(count):
        drive.write_node(writer, index)
    return drive


def assert_same_edges(read: tuple[Edge, ...] | list[Edge], written: list[Edge]) -> None:
    assert [(e.a, e.b, e.kind) for e in read] == [(e.a, e.b, e.kind) for e in written]
    for a, b in zip(read, written, strict=True):
        np.testing.assert_array_equal(a.a_from_b.matrix(), b.a_from_b.matrix())
        np.testing.assert_array_equal(a.covariance, b.covariance)
