"""The stage that opens a map: 4,000 nodes, 31,584 edges, 183,637 attempts."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from engram.geometry.se3 import SE3
from engram.graph.model import Edge, EdgeKind, Node, PathEntry, PathEntryKind, path_id
from engram.graph.paths import Attempts
from engram.maps.map import Map
from engram.maps.writer import RevisionWriter
from engram_lab.bench.data import BenchData
from engram_lab.bench.plain import PlainPipeline
from engram_lab.bench.stage import Prepared
from engram_lab.synthetic_places import (
    CAMERA,
    DESCRIPTOR,
    FRONTEND,
    drive_of,
    landmark_bytes,
    node_of,
    stored,
)

SESSIONS, SESSION_NODES, EDGES, ATTEMPTS = 8, 500, 31_584, 183_637
_SIGMA = np.diag([0.01**2] * 3 + [0.002**2] * 3)
_LANDMARKS = 20  # of a node: opening reads none of them


def prepare_opening(data: BenchData, plain: PlainPipeline | None) -> Prepared:
    """Open the map and read all that a localiser needs of it: graph, paths and attempts."""
    del data, plain
    folder = tempfile.TemporaryDirectory(prefix="engram-bench-")  # lives as long as `ours`
    write_map(Path(folder.name) / "many.engram")

    def ours(_: int) -> dict[str, int]:
        with Map.open(Path(folder.name) / "many.engram") as store:
            graph, attempts = store.graph, store.attempts
            return {"nodes": len(graph), "edges": len(graph.edges), "attempts": len(attempts.node)}

    return Prepared(ours)


def write_map(path: Path) -> None:
    """Eight drives along one street, tied to each other as mapping and merging tie them."""
    rng = np.random.default_rng(0)
    blob = landmark_bytes(rng, None, _LANDMARKS)
    with (
        Map.create(path) as store,
        store.begin_revision(author="bench", message="made up", configuration={}) as writer,
    ):
        drives = [_write_drive(writer, number, blob) for number in range(SESSIONS)]
        nodes = [node for drive in drives for node in drive]
        left = EDGES - SESSIONS * (SESSION_NODES - 1)
        for a, b in _pairs(rng, left):
            metres = float(b % SESSION_NODES - a % SESSION_NODES)
            pose = SE3.exp([0.1, 0.0, metres, 0.0, 0.01, 0.0])
            writer.add_edge(Edge(nodes[a].id, nodes[b].id, EdgeKind.PROXIMITY, pose, _SIGMA))
        each = np.diff(np.linspace(0, ATTEMPTS, SESSIONS + 1).astype(int))
        for number, count in enumerate(each):
            session = nodes[number * SESSION_NODES].session
            writer.copy_attempts(session, _attempts(rng, count), [node.id for node in nodes])
        writer.commit()


def _write_drive(writer: RevisionWriter, number: int, blob: bytes) -> list[Node]:
    start_ns = 1_000_000_000_000 * (number + 1)
    drive = drive_of("bench", start_ns)
    writer.add_session(drive, CAMERA, descriptor=DESCRIPTOR, frontend=FRONTEND)
    nodes: list[Node] = []
    step = SE3(np.eye(3), np.array([0.0, 0.0, 1.0]))
    for at in range(SESSION_NODES):
        node = node_of(drive, start_ns + at * 100_000_000, float(at))
        writer.copy_node(stored(node, blob))
        if nodes:
            writer.add_edge(Edge(nodes[-1].id, node.id, EdgeKind.ODOMETRY, step, _SIGMA))
        kind = PathEntryKind.SAVED
        writer.add_path_entry(PathEntry(path_id(drive.id), at, node.id, kind, node.stamp_ns))
        nodes.append(node)
    return nodes


def _pairs(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 2) int: pairs of nodes of two drives, at most 5 m apart, each once."""
    places = SESSIONS * SESSION_NODES
    a = rng.integers(0, places, 4 * count)
    there = np.clip(a % SESSION_NODES + rng.integers(-5, 6, len(a)), 0, SESSION_NODES - 1)
    b = (a // SESSION_NODES + rng.integers(1, SESSIONS, len(a))) % SESSIONS * SESSION_NODES + there
    return np.unique(np.column_stack([a, b]), axis=0)[rng.permutation(count)]


def _attempts(rng: np.random.Generator, count: int) -> Attempts:
    nodes = SESSIONS * SESSION_NODES
    return Attempts(
        session=np.zeros(count, np.int32),
        iteration=np.arange(count, dtype=np.int64) // 2,
        reference=rng.integers(0, nodes, count).astype(np.int32),
        node=rng.integers(0, nodes, count).astype(np.int32),
        **{
            name: rng.uniform(0.01, 2, count).astype(np.float32)
            for name in ("along_m", "across_m", "yaw_rad", "sigma_m", "sigma_yaw_rad")
        },
        accepted=rng.random(count) < 0.5,
        inliers=rng.integers(0, 300, count).astype(np.int32),
        rank=rng.integers(0, 20, count).astype(np.int32),
        policy=np.zeros(count, np.int32),
        policies=("recall",),
    )
