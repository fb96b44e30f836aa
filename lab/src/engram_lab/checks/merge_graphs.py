"""Random small maps handed in to a centre: what must hold whatever they look like (method §7).

    python -m engram_lab.checks.merge_graphs                                   # 10,000 cases
    python -m engram_lab.checks.merge_graphs --first 2000 --cases 500          # some of them

A case is a few robots' maps: drives past places of a road in one of two looks, strung by
odometry with holes and branches, tied here and there; some robots went out with the map of another
and know more of its attempts than it does. They are merged by three rules of what is omitted.
For each case:

- the merged map is sound (`engram check`), and every node handed in is in it or omitted;
- every remembered attempt that was handed in is remembered;
- nodes that hang together in a robot's map do so in the centre, and it falls into no more parts
  than both had before;
- handing any map in again changes nothing;
- maps of the same content, written in another order, give the same centre;
- a download from it, by a policy drawn at random, is sound, falls into no more parts than the same
  nodes do in the centre, has the same bytes when it is made again, and changes nothing when it is
  handed back.

Prints every violation with its seed, and exits with 1 if there is one.
"""

from __future__ import annotations

import random
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np

from engram.errors import InputError
from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.merging import merge
from engram.fleet.merge.report import MergeReport
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
    SessionId,
    path_id,
)
from engram.graph.paths import Attempts
from engram.maps.map import Map
from engram.maps.map_files import check_file
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

Item = TypeVar("Item")
OPTIONS = MergeOptions(ranking="distance", lanes=1, rounds=8, relocaliser="exhaustive")
# Turn about: every match omits; as by default; what other drives rely on is never omitted.
SURE_INLIERS = (0, OPTIONS.sure_inliers, 1_000)
PLACES, APPEARANCES, LANDMARKS = 6, 2, 70
# Drives set out some hours apart, at all hours of day.
APART_NS = 5 * 3600 * 10**9
SIGMA = np.diag([0.02**2] * 3 + [0.003**2] * 3)


@dataclass
class RandomMap:
    """What one robot hands in, as records."""

    sessions: list[Session] = field(default_factory=list)
    nodes: dict[NodeId, tuple[Node, int, int]] = field(default_factory=dict)
    edges: dict[tuple[NodeId, NodeId, EdgeKind], Edge] = field(default_factory=dict)
    entries: list[PathEntry] = field(default_factory=list)
    attempts: dict[SessionId, list[Attempt]] = field(default_factory=dict)

    def copy(self) -> RandomMap:
        """What a robot goes out with."""
        return RandomMap(
            list(self.sessions),
            dict(self.nodes),
            dict(self.edges),
            list(self.entries),
            dict(self.attempts),
        )

    def forget(self, rng: random.Random) -> None:
        """Some attempts are not in this map, as in a download."""
        self.attempts = {
            session: [one for one in made if rng.random() < 0.6]
            for session, made in self.attempts.items()
        }


@cache
def blob_of(place: int, appearance: int, look: int) -> bytes:
    """The landmarks of a place in an appearance, in the pixels and bits of one look at it."""
    return landmark_bytes(
        np.random.default_rng([place, appearance]),
        np.random.default_rng([place, appearance, look]),
        LANDMARKS,
    )


def add_drive(made: RandomMap, number: int, rng: random.Random) -> None:
    """One drive past a stretch of the road, saved here and there."""
    start_ns = APART_NS * (number + 1)
    drive = drive_of(f"r{rng.randrange(3)}", start_ns, str(number))
    drive = replace(drive, clock=Clock.UTC, longitude_deg=0.0)
    made.sessions.append(drive)
    first, appearance = rng.randrange(PLACES), rng.randrange(APPEARANCES)
    own: list[NodeId] = []
    for at in range(rng.randrange(0, 8)):
        stamp_ns = start_ns + at * 1_000_000
        node = node_of(drive, stamp_ns, float(at))
        made.nodes[node.id] = (node, first + at, appearance)
        if own and rng.random() < 0.85:
            add_edge(made, rng.choice([own[-1], own[-1], rng.choice(own)]), node.id, "odometry")
        others = list(made.nodes)
        if rng.random() < 0.25 and len(others) > 1:
            kind = rng.choice(["tie", "match", "proximity"])
            add_edge(made, rng.choice(others), node.id, kind)
        own.append(node.id)
    walked = [rng.choice(list(made.nodes)) for _ in range(rng.randrange(12))] if made.nodes else []
    for sequence, on_path in enumerate(own + walked):
        kind = PathEntryKind.SAVED if sequence < len(own) else PathEntryKind.MATCHED
        made.entries.append(PathEntry(path_id(drive.id), sequence, on_path, kind, sequence))
    made.attempts[drive.id] = [
        Attempt(
            iteration=number,
            reference=rng.choice(own),
            node=rng.choice(list(made.nodes)),
            along_m=rng.uniform(-8, 8),
            across_m=rng.uniform(-2, 2),
            yaw_rad=rng.uniform(-3, 3),
            sigma_m=rng.uniform(0, 2),
            sigma_yaw_rad=rng.uniform(0, 0.2),
            accepted=rng.random() < 0.5,
            inliers=rng.randrange(100),
            rank=rng.randrange(400),
            policy=rng.choice(["recall", "distance"]),
        )
        for number in range(rng.randrange(6) if own else 0)
    ]


def add_edge(made: RandomMap, a: NodeId, b: NodeId, kind: str) -> None:
    """A true edge: places are a metre apart."""
    if a == b:
        return
    ahead_m = float(made.nodes[b][1] - made.nodes[a][1])
    edge = Edge(a, b, EdgeKind(kind), SE3(np.eye(3), np.array([0.0, 0.0, ahead_m])), SIGMA)
    made.edges[a, b, edge.kind] = edge


def random_fleet(seed: int) -> list[RandomMap]:
    """Two or three robots' maps; a later one may have gone out with an earlier one's."""
    rng = random.Random(seed)
    fleet: list[RandomMap] = []
    number = 0
    for _ in range(rng.randrange(2, 4)):
        made = RandomMap()
        if fleet and rng.random() < 0.4:
            other = rng.choice(fleet)
            made = other.copy()
            other.forget(rng)
        for _ in range(rng.randrange(1, 3)):
            add_drive(made, number, rng)
            number += 1
        fleet.append(made)
    return fleet


def write(made: RandomMap, path: Path, order: int) -> None:
    """The map's file; `order` decides in which order the rows come."""
    rng = random.Random(order)
    with (
        Map.create(path) as store,
        store.begin_revision(author="robot", message="", configuration={}) as writer,
    ):
        for one in shuffled(made.sessions, rng):
            writer.add_session(one, CAMERA, descriptor=DESCRIPTOR, frontend=FRONTEND)
        for node, place, appearance in shuffled(made.nodes.values(), rng):
            blob = blob_of(place, appearance, node.stamp_ns % 1_000_003)
            writer.copy_node(stored(node, blob))
        for edge in shuffled(made.edges.values(), rng):
            writer.add_edge(edge)
        for entry in shuffled(made.entries, rng):
            writer.add_path_entry(entry)
        for session, tried in shuffled(made.attempts.items(), rng):
            writer.copy_attempts(session, *Attempts.of(tried))
        writer.commit()


def shuffled(items: Iterable[Item], rng: random.Random) -> list[Item]:
    found = list(items)
    rng.shuffle(found)
    return found


def merged(centre: Path, robot: Path, seed: int) -> MergeReport:
    options = replace(OPTIONS, sure_inliers=SURE_INLIERS[seed % len(SURE_INLIERS)])
    return merge(centre, [robot], options)[0]


def parts(path: Path) -> tuple[dict[NodeId, int], int]:
    """The part in which each node handed in lies, itself or its equivalent; and how many."""
    with Map.open(path) as opened:
        labels = opened.graph.components()
        found = {node.id: int(labels[at]) for at, node in enumerate(opened.graph.nodes)}
        for omission in opened.omissions.values():
            found[omission.omitted] = found[omission.node]
    return found, int(labels.max(initial=-1)) + 1


def remembered(path: Path) -> Counter[tuple[SessionId, int, int, bool, int]]:
    """The remembered attempts of a map, by what carrying them over leaves alone."""
    with Map.open(path) as store:
        contents = store.load()
    made = contents.attempts
    sessions = [contents.sessions[at].id for at in made.session]
    columns = (made.iteration, made.rank, made.accepted, made.inliers)
    return Counter(zip(sessions, *(column.tolist() for column in columns), strict=True))


@dataclass
class Case:
    """What one case came to."""

    violations: list[str]
    sent: str = ""


def violations(seed: int, case: Case) -> Iterator[str]:
    """What does not hold for one case."""
    fleet = random_fleet(seed)
    with tempfile.TemporaryDirectory(prefix="engram-graphs-") as made:
        folder = Path(made)
        centre, twin = folder / "centre.engram", folder / "twin.engram"
        robots = [folder / f"robot-{number}.engram" for number in range(len(fleet))]
        before = 0
        for number, (robot, content) in enumerate(zip(robots, fleet, strict=True)):
            write(content, robot, order=0)
            report = merged(centre, robot, seed)
            ours, after = parts(centre)
            theirs, of_robot = parts(robot)
            if missing := theirs.keys() - ours.keys():
                yield f"merge {number}: nodes {missing} are neither taken nor omitted"
            together: dict[int, set[int]] = {}
            for node, label in theirs.items():
                together.setdefault(label, set()).add(ours.get(node, -1))
            if any(len(labels) > 1 for labels in together.values()):
                yield f"merge {number}: nodes that hung together are in {together}"
            if lost := remembered(robot) - remembered(centre):
                yield f"merge {number}: attempts {lost} are not remembered"
            if after > before + of_robot or after != report.components:
                yield f"merge {number}: {after} parts of {before} and {of_robot}"
            before = after
        if problems := check_file(centre).problems:
            yield f"the centre is not sound: {problems}"
        yield from _again(centre, robots, seed)
        yield from _downloads(centre, seed, case)
        for number, content in enumerate(fleet):
            other = folder / f"twin-{number}.engram"
            write(content, other, order=seed + 1)
            merged(twin, other, seed)
        if content_hash(twin) != content_hash(centre):
            yield "maps of the same content give another centre"


def _again(centre: Path, robots: list[Path], seed: int) -> Iterator[str]:
    known = content_hash(centre)
    for number, robot in enumerate(robots):
        report = merged(centre, robot, seed)
        if report.changed or report.revision is not None or content_hash(centre) != known:
            yield f"handing in {number} again changes the centre: {report.to_dict()}"


def _downloads(centre: Path, seed: int, case: Case) -> Iterator[str]:
    rng = random.Random(seed)
    ours, _ = parts(centre)
    options = _mission(rng, centre, sorted(ours))
    copies = [centre.with_name(f"download-{number}.engram") for number in range(2)]
    try:
        for copy in copies:
            download(centre, copy, options)
    except InputError:
        return  # the centre has nothing for that hour, or the budget is too small for one node
    case.sent = options.select
    if copies[0].read_bytes() != copies[1].read_bytes():
        yield f"{options}: made again it has other bytes"
    if problems := check_file(copies[0]).problems:
        yield f"{options}: not sound: {problems}"
    with Map.open(copies[0]) as opened:
        sent = [node.id for node in opened.graph.nodes]
        apart = int(opened.graph.components().max(initial=-1)) + 1
    if apart > len({ours[node] for node in sent}):
        yield f"{options}: {apart} parts of {len(sent)} nodes, where the centre has fewer"
    known = content_hash(centre)
    merged(centre, copies[0], seed)
    if content_hash(centre) != known:
        yield f"{options}: handing it back changes the centre"


def _mission(rng: random.Random, centre: Path, nodes: list[NodeId]) -> DownloadOptions:
    policy = rng.choice(["copy", "tod", "paths", "tod+paths", "budget", "region"])
    hour = float(rng.randrange(24))
    if policy == "region" and nodes:
        return DownloadOptions(policy, near=(str(rng.choice(nodes)),), radius_m=3.0)
    if policy == "budget":
        size = rng.randrange(centre.stat().st_size // 2, centre.stat().st_size)
        return DownloadOptions(policy, depart_h=hour, arrive_h=hour, budget_bytes=size)
    if policy == "tod":
        return DownloadOptions(policy, depart_h=hour)
    if policy in ("paths", "tod+paths"):
        return DownloadOptions(policy, depart_h=hour, epoch_min=360.0)
    return DownloadOptions(policy)


def content_hash(path: Path) -> str:
    with Map.open(path) as store:
        return store.content_hash()


def told(seed: int) -> Case:
    """For a pool of processes."""
    case = Case([])
    try:
        case.violations.extend(violations(seed, case))
    except Exception as error:  # a crash is a violation
        case.violations.append(f"{type(error).__name__}: {error}")
    return case


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.cases)
    found = 0
    sent: Counter[str] = Counter()
    with ProcessPoolExecutor(asked.workers) as pool:
        for seed, case in zip(seeds, pool.map(told, seeds, chunksize=4), strict=True):
            sent[case.sent or "nothing fitted"] += 1
            for word in case.violations:
                found += 1
                print(f"seed {seed}: {word}", flush=True)
            if (seed - asked.first + 1) % 500 == 0:
                print(f"{seed - asked.first + 1} cases, {found} violations", flush=True)
    print(f"{asked.cases} cases, {found} violations; downloads: {dict(sent.most_common())}")
    sys.exit(found > 0)


if __name__ == "__main__":
    main()
