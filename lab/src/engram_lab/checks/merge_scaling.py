"""Merging a large robot's map into a larger centre: time and memory (method §7).

    python -m engram_lab.checks.merge_scaling                 # 5,000 to 20,000 into 100,000
    python -m engram_lab.checks.merge_scaling --centre 2000 --robots 500,1000
    python -m engram_lab.checks.merge_scaling --centre 20000 --robots 50 --without-words

The maps are made of synthetic places, one metre from the next, each with landmarks of its own. Half
of a robot's drives go past places of the centre, in other pixels and bits, and are omitted; half go
where nobody was, and are taken. Every merge runs in a process of its own on a fresh copy of the
centre; its time by the clock and on the cores and its greatest resident set are printed. The first
merge into a map also makes the words of its nodes: ``--without-words`` recognises no places.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.merging import merge
from engram.geometry.se3 import SE3
from engram.graph.model import Edge, EdgeKind, Node, PathEntry, PathEntryKind, path_id
from engram.maps.map import Map
from engram.maps.map_files import copy_map
from engram.maps.writer import RevisionWriter
from engram_lab.programs import command_line
from engram_lab.synthetic_places import (
    CAMERA,
    DESCRIPTOR,
    FRONTEND,
    drive_of,
    landmark_bytes,
    node_of,
    stored,
)

SESSION_NODES = 500
LANDMARKS = 100
STEP = SE3(np.eye(3), np.array([0.0, 0.0, 1.0]))
SIGMA = np.diag([0.01**2] * 3 + [0.002**2] * 3)
GIB = 2**30


def write_session(
    writer: RevisionWriter,
    robot: str,
    number: int,
    places: range,
    rng: np.random.Generator | None,
    landmarks: int = LANDMARKS,
) -> None:
    """One drive past some places, saved whole."""
    start_ns = 1_000_000_000_000 * (number + 1)
    drive = drive_of(robot, start_ns)
    writer.add_session(drive, CAMERA, descriptor=DESCRIPTOR, frontend=FRONTEND)
    before: Node | None = None
    for at, place in enumerate(places):
        stamp_ns = start_ns + at * 100_000_000
        node = node_of(drive, stamp_ns, float(at))
        blob = landmark_bytes(np.random.default_rng(place), rng, landmarks)
        writer.copy_node(stored(node, blob))
        if before is not None:
            writer.add_edge(Edge(before.id, node.id, EdgeKind.ODOMETRY, STEP, SIGMA))
        entry = PathEntry(path_id(drive.id), at, node.id, PathEntryKind.SAVED, stamp_ns)
        writer.add_path_entry(entry)
        before = node


def write_map(path: Path, robot: str, places: list[range], seed: int | None) -> None:
    rng = None if seed is None else np.random.default_rng(seed)
    with (
        Map.create(path) as store,
        store.begin_revision(author=robot, message="synthetic", configuration={}) as writer,
    ):
        for number, some in enumerate(places):
            write_session(writer, robot, number, some, rng)
        writer.commit()


def robot_places(nodes: int, centre: int) -> list[range]:
    """Drives of the centre's places and of others, in turn."""
    sessions = max(nodes // SESSION_NODES, 2)
    each = nodes // sessions
    known = np.linspace(0, centre - each, sessions // 2).astype(int)
    places = []
    for number in range(sessions):
        first = int(known[number // 2]) if number % 2 == 0 else centre + number * each
        places.append(range(first, first + each))
    return places


def merge_once(centre: str, robot: str, words: str) -> None:
    """In a process of its own: the merge, then its figures as JSON."""
    options = MergeOptions() if words == "words" else MergeOptions(relocaliser="none")
    started = time.perf_counter()
    (report,) = merge(Path(centre), [Path(robot)], options)
    seconds = time.perf_counter() - started
    used = resource.getrusage(resource.RUSAGE_SELF)
    peak = used.ru_maxrss * 1024
    print(
        json.dumps(
            {
                "seconds": seconds,
                "cpu_s": used.ru_utime + used.ru_stime,
                "peak_gib": peak / GIB,
                "taken": report.taken,
                "omitted": report.omitted,
                "match_attempts": report.match_attempts,
            }
        )
    )


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--centre", type=int, default=100_000)
    parser.add_argument("--robots", default="0,5000,10000,20000", help="nodes of each robot's map")
    parser.add_argument("--folder", type=Path, help="keep the maps here")
    parser.add_argument("--without-words", action="store_true", help="recognise no places")
    parser.add_argument("--merge", nargs=3, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.merge:
        merge_once(*asked.merge)
        return
    with tempfile.TemporaryDirectory() as made:
        folder = asked.folder or Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        centre = folder / f"centre-{asked.centre}.engram"
        if not centre.exists():
            starts = range(0, asked.centre, SESSION_NODES)
            drives = [range(at, min(at + SESSION_NODES, asked.centre)) for at in starts]
            write_map(centre, "centre", drives, None)
        for nodes in map(int, asked.robots.split(",")):
            words = "none" if asked.without_words else "words"
            measure(folder, centre, nodes, asked.centre, words)


def measure(folder: Path, centre: Path, nodes: int, size: int, words: str) -> None:
    """One line: a map of so many nodes merged into a copy of the centre."""
    robot, copy = folder / f"robot-{nodes}.engram", folder / "copy.engram"
    if not robot.exists():
        write_map(robot, f"robot-{nodes}", robot_places(nodes, size) if nodes else [], seed=nodes)
    copy.unlink(missing_ok=True)
    copy_map(centre, copy)
    command = [sys.executable, "-m", __spec__.name, "--merge", str(copy), str(robot), words]
    found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    copy.unlink()
    print(
        f"{nodes:7d} nodes into {size}: {found['seconds']:8.1f} s "
        f"({found['cpu_s']:.1f} s of a core), peak {found['peak_gib']:.2f} "
        f"GiB, {found['taken']} taken, {found['omitted']} omitted, "
        f"{found['match_attempts']} attempts",
        flush=True,
    )


if __name__ == "__main__":
    main()
