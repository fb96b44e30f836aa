"""Made-up situations in which a ranking policy must order candidates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from engram.geometry import CameraId
from engram.graph.attempts import Attempts
from engram.graph.basin import MatchBasin
from engram.graph.graph import ExperienceGraph
from engram.graph.model import (
    Attempt,
    Clock,
    Node,
    NodeId,
    PathEntry,
    PathEntryKind,
    PathId,
    Session,
    SessionId,
    node_id,
    path_id,
)
from engram.graph.neighbourhood import Neighbourhood
from engram.graph.paths import ALL_KINDS, PathMemory
from engram.places.words import NodeWords
from engram.ranking import (
    Background,
    Foreseen,
    Lessons,
    Observations,
    RankingContext,
    RunAttempts,
)

CAMERA = CameraId("0" * 32)
_HOUR_NS = 3_600_000_000_000


def session_uuid(number: int) -> SessionId:
    """Id of a session by its number."""
    return SessionId(UUID(int=(0x5E << 120) | number))


def path_uuid(number: int) -> PathId:
    """Id of a path by its number."""
    return PathId(UUID(int=(0xBA << 120) | number))


def make_node(session: int, index: int, driven_m: float | None = None) -> Node:
    """Node `index` of a session, one second after the one before, 1 m driven unless stated."""
    drive = session_uuid(session)
    stamp_ns = index * 1_000_000_000
    metres = float(index) if driven_m is None else driven_m
    return Node(node_id(drive, stamp_ns), drive, stamp_ns, CAMERA, metres)


def flat_graph(count: int, sessions: int = 1) -> ExperienceGraph:
    """Nodes without edges; sessions take turns in saving them."""
    graph = ExperienceGraph()
    for index in range(count):
        graph.add_node(make_node(index % sessions, index))
    return graph


def session_record(number: int, hour: float | None = None, day: int = 0) -> Session:
    """A drive on a day after 1970, at an hour by the sun; no clock without an hour."""
    start_ns = int(((hour or 0.0) + 24 * day) * _HOUR_NS)
    clock = Clock.UNKNOWN if hour is None else Clock.UTC
    return Session(session_uuid(number), "robot", CAMERA, start_ns, clock, longitude_deg=0.0)


class MadeUpWords(NodeWords):
    """Visual words of nodes as stated; nodes that are left out show none."""

    def __init__(
        self, graph: ExperienceGraph, of_nodes: Mapping[int, Sequence[int]], count: int = 50
    ) -> None:
        self.idf = np.linspace(1.0, 2.0, count)
        known = {node: shown for node, shown in of_nodes.items() if node < len(graph)}
        self._of_nodes = {graph.node(node).id: shown for node, shown in known.items()}

    def of_node(self, node: NodeId) -> NDArray[np.int32]:
        """(n,) int32 words of a node."""
        return np.array(self._of_nodes.get(node, []), np.int32)


# At how many metres driven, node, success rate, accepted.
RunAttempt = tuple[float, int, float, bool]
# Session, node, success rate, accepted.
Lesson = tuple[int, int, float, bool]


def run_of(attempts: Sequence[RunAttempt], driven_m: float = 0.0) -> RunAttempts:
    """This run's attempts, with 100 of 200 landmarks matched.

    The lower the rate the farther the node was, 0.9 being 0.5 m.
    """
    at_m, nodes, rates, accepted = zip(*attempts, strict=True) if attempts else ([], [], [], [])
    taken = np.array(accepted, np.bool_)
    return RunAttempts(
        driven_m,
        np.array(at_m, np.float64),
        np.array(nodes, np.int32),
        5 * (1 - np.array(rates, np.float64)),
        np.array(rates, np.float64),
        taken,
        np.where(taken, 100, 0),
        np.full(len(taken), 200),
    )


def memory_of(
    graph: ExperienceGraph,
    paths: Sequence[Sequence[int]],
    kinds: frozenset[PathEntryKind] = ALL_KINDS,
) -> PathMemory:
    """Path m holds the nodes (dense indices) of paths[m]."""
    memory = PathMemory(graph, kinds)
    for number, nodes in enumerate(paths):
        for sequence, index in enumerate(nodes):
            entry = PathEntry(
                path_uuid(number), sequence, graph.node(index).id, PathEntryKind.MATCHED, sequence
            )
            memory.add(entry)
    return memory


def neighbourhood_of(
    nodes: Sequence[int] | NDArray[np.int32], along_m: Sequence[float] | NDArray[np.float64]
) -> Neighbourhood:
    """Candidates straight ahead or behind, predicted without error.

    Args:
        nodes: (Y,) int32 dense indices.
        along_m: (Y,) float64, how far ahead each is, m.
    """
    nodes = np.asarray(nodes, np.int32)
    along = np.asarray(along_m, np.float64)
    poses = np.tile(np.eye(4), (len(nodes), 1, 1))
    poses[:, 2, 3] = along
    zeros = np.zeros(len(nodes))
    pivots = np.zeros((len(nodes), 3))
    return Neighbourhood(nodes, poses, np.abs(along), along, zeros, zeros, zeros, zeros, pivots)


def lessons_of(graph: ExperienceGraph, attempts: Sequence[Lesson]) -> Lessons:
    """What sessions learnt from attempts."""
    if not len(graph):
        return Lessons.none()
    count = max([int(graph.sessions.max()), *(attempt[0] for attempt in attempts)]) + 1
    viewers = [path_id(session_uuid(number)) for number in range(count)]
    made = [
        Attempt(drive, graph.node(node).id, graph.node(node).id, 0, 0, 0, 0, 0, accepted, 0, 0, "")
        for drive, node, _, accepted in attempts
    ]
    columns, ids = Attempts.of(made)
    index = np.array([graph.index(node) for node in ids], np.int32)
    columns = replace(columns, session=columns.iteration.astype(np.int32), node=index[columns.node])
    rates = np.array([rate for _, _, rate, _ in attempts], np.float64)
    return Lessons.learnt(graph, PathMemory(graph), viewers, columns, rates)


def make_context(
    *,
    graph: ExperienceGraph | None = None,
    paths: Sequence[Sequence[int]] = (),
    candidates: Sequence[int] = (),
    along_m: Sequence[float] | NDArray[np.float64] | None = None,
    observed: Sequence[int] = (),
    outcomes: Sequence[bool] = (),
    reference: int | None = None,
    own_path: PathId | None = None,
    focal_px: float = 256.0,
    stamp_ns: int = 0,
    seed: int = 0,
    sessions: int = 1,
    run: Sequence[RunAttempt] = (),
    hour: float | None = None,
    day: int | None = None,
    hours: Sequence[float | None] | None = None,
    words: Mapping[int, Sequence[int]] | None = None,
    live_words: Sequence[int] | None = None,
    lessons: Sequence[Lesson] = (),
) -> RankingContext:
    """A context over dense indices.

    Sessions take turns in saving nodes; `hours` is their hour of day, `words` what nodes show.
    `along_m`, (Y,) float64, is how far ahead each candidate is; 0.1 m apart unless stated.
    """
    along = np.arange(len(candidates)) / 10 if along_m is None else np.asarray(along_m, np.float64)
    if graph is None:
        attempted = [attempt[1] for attempt in (*run, *lessons)]
        on_paths = (node for path in paths for node in path)
        used = [*candidates, *observed, *on_paths, *attempted, reference or 0]
        graph = flat_graph(max(used, default=0) + 1, sessions)
    records = [session_record(number, one) for number, one in enumerate(hours or [])]
    return RankingContext(
        neighbourhood=neighbourhood_of(candidates, along),
        graph=graph,
        path_memory=memory_of(graph, paths),
        basin=MatchBasin.of(focal_px),
        observations=Observations(np.array(observed, np.int32), np.array(outcomes, np.bool_)),
        reference=reference,
        own_path=own_path,
        stamp_ns=stamp_ns,
        seed=seed,
        run=run_of(run),
        hour=hour,
        day=day,
        background=Background(
            {record.id: record for record in records},
            lessons_of(graph, lessons),
            None if words is None else MadeUpWords(graph, words),
        ),
        live_words=None if live_words is None else lambda: np.array(sorted(live_words), np.int32),
    )


def foreknown(context: RankingContext, seed: int = 0) -> RankingContext:
    """The context with made-up foresight, a property of the node and not of the row."""
    nodes = context.neighbourhood.nodes

    def foresee() -> Foreseen:
        draws = np.random.default_rng(seed)
        inliers = draws.integers(0, 4, len(context.graph)) * 10
        return Foreseen(inliers[nodes] >= 20, inliers[nodes])

    return replace(context, foresee=foresee)


def random_context(seed: int) -> RankingContext:
    """A situation drawn at random; few distances, so that ties are common, and much is missing."""
    draws = np.random.default_rng(seed)
    nodes = int(draws.integers(1, 26))

    def some() -> list[int]:
        return list(map(int, draws.permutation(nodes)[: draws.integers(0, nodes + 1)]))

    def maybe(value: float) -> float | None:
        return None if draws.random() < 0.4 else value

    def words() -> list[int]:
        return sorted(draws.permutation(10)[: draws.integers(0, 6)].tolist())

    candidates, observed = some(), some()
    run = [
        (float(draws.uniform(-50, 0)), int(draws.integers(nodes)), rate, bool(draws.integers(2)))
        for rate in draws.choice([0.0, 0.3, 0.9, np.nan], draws.integers(0, 13)).tolist()
    ]
    lessons = [
        (int(draws.integers(5)), int(draws.integers(nodes)), rate, bool(draws.integers(2)))
        for rate in draws.choice([0.0, 0.3, 0.9], draws.integers(0, 13)).tolist()
    ]
    context = make_context(
        graph=flat_graph(nodes, int(draws.integers(1, 6))),
        paths=[some() for _ in range(draws.integers(0, 9))],
        candidates=candidates,
        along_m=draws.choice([-3.0, -0.5, 0.0, 0.5, 1.0, 6.0], len(candidates)),
        observed=observed,
        outcomes=[bool(draws.integers(2)) for _ in observed],
        reference=int(draws.integers(nodes)) if draws.integers(2) else None,
        own_path=path_uuid(0) if draws.integers(2) else None,
        stamp_ns=int(draws.integers(2**62)),
        run=sorted(run, key=lambda attempt: attempt[0]),
        hour=maybe(draws.uniform(0, 24)),
        hours=[maybe(draws.uniform(0, 24)) for _ in range(draws.integers(0, 6))],
        words={node: words() for node in some()} if draws.integers(2) else None,
        live_words=words() if draws.integers(2) else None,
        lessons=lessons,
    )
    return foreknown(context, seed)
