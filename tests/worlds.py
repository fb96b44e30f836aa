"""Small experience graphs, path memories and ranking contexts for tests."""

from dataclasses import replace
from uuid import UUID

import numpy as np

from engram.geometry import SE3, CameraId
from engram.graph.attempts import Attempts
from engram.graph.basin import MatchBasin
from engram.graph.graph import ExperienceGraph
from engram.graph.model import (
    Attempt,
    Clock,
    Edge,
    EdgeKind,
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
from engram.maps import MapContents
from engram.ranking import (
    Background,
    Lessons,
    Observations,
    RankingContext,
    RunAttempts,
)

CAMERA = CameraId("0" * 32)


def session_uuid(number: int) -> SessionId:
    return SessionId(UUID(int=(0x5E << 120) | number))


def path_uuid(number: int) -> PathId:
    return PathId(UUID(int=(0xBA << 120) | number))


def make_node(session: int, index: int, driven_m: float | None = None) -> Node:
    """Node `index` of a session, 1 m driven per index unless told."""
    drive = session_uuid(session)
    stamp_ns = index * 1_000_000_000
    metres = float(index) if driven_m is None else driven_m
    return Node(node_id(drive, stamp_ns), drive, stamp_ns, CAMERA, metres)


def covariance_of(sigma_m: float, sigma_rad: float) -> np.ndarray:
    return np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)


def make_edge(a: NodeId, b: NodeId, a_from_b: SE3, kind=EdgeKind.ODOMETRY, sigma=(0.02, 0.001)):
    return Edge(a, b, kind, a_from_b, covariance_of(*sigma))


def forward(metres: float, across_m: float = 0.0, yaw_rad: float = 0.0) -> SE3:
    """A pose ahead, to the right, and turned to the right."""
    turn = SE3.exp([0, 0, 0, 0, yaw_rad, 0])
    return SE3(turn.rotation, np.array([across_m, 0.0, metres]))


def flat_graph(count: int, sessions: int = 1) -> ExperienceGraph:
    """Nodes without edges; sessions take turns in saving them."""
    graph = ExperienceGraph()
    for index in range(count):
        graph.add_node(make_node(index % sessions, index))
    return graph


def session_record(number: int, hour: float | None = None, day: int = 0) -> Session:
    """A drive on a day after 1970, at an hour by the sun; no clock without an hour."""
    start_ns = int(((hour or 0.0) + 24 * day) * 3_600_000_000_000)
    clock = Clock.UNKNOWN if hour is None else Clock.UTC
    return Session(session_uuid(number), "robot", CAMERA, start_ns, clock, longitude_deg=0.0)


class MadeUpWords:
    """Words of nodes and frames as a test says; nodes that it leaves out show none."""

    def __init__(self, graph, of_nodes: dict[int, list[int]], count: int = 50) -> None:
        self.idf = np.linspace(1.0, 2.0, count)
        known = {node: shown for node, shown in of_nodes.items() if node < len(graph)}
        self._of_nodes = {graph.node(node).id: shown for node, shown in known.items()}

    def of_frame(self, frame: object) -> np.ndarray:
        raise NotImplementedError("contexts hold the live words themselves")

    def of_node(self, node: NodeId) -> np.ndarray:
        return np.array(self._of_nodes.get(node, []), np.int32)


def run_of(attempts, driven_m: float = 0.0) -> RunAttempts:
    """This run's attempts: (at_m, node, rate, accepted) each, with 100 of 200 landmarks matched.

    The lower the rate the farther the node was, 0.9 being 0.5 m.
    """
    at_m, nodes, rates, accepted = zip(*attempts, strict=True) if attempts else ([], [], [], [])
    accepted = np.array(accepted, np.bool_)
    return RunAttempts(
        driven_m,
        np.array(at_m, np.float64),
        np.array(nodes, np.int32),
        5 * (1 - np.array(rates, np.float64)),
        np.array(rates, np.float64),
        accepted,
        np.where(accepted, 100, 0),
        np.full(len(accepted), 200),
    )


def memory_of(graph: ExperienceGraph, paths, kinds=ALL_KINDS) -> PathMemory:
    """Path m holds the nodes (dense indices) of paths[m]."""
    memory = PathMemory(graph, kinds)
    for number, nodes in enumerate(paths):
        for sequence, index in enumerate(nodes):
            entry = PathEntry(
                path_uuid(number), sequence, graph.node(index).id, PathEntryKind.MATCHED, sequence
            )
            memory.add(entry)
    return memory


def neighbourhood_of(nodes, along_m) -> Neighbourhood:
    """Candidates straight ahead or behind, predicted without error."""
    nodes = np.asarray(nodes, np.int32)
    along = np.asarray(along_m, np.float64)
    poses = np.tile(np.eye(4), (len(nodes), 1, 1))
    poses[:, 2, 3] = along
    zeros = np.zeros(len(nodes))
    pivots = np.zeros((len(nodes), 3))
    return Neighbourhood(nodes, poses, np.abs(along), along, zeros, zeros, zeros, zeros, pivots)


def lessons_of(graph, attempts) -> Lessons:
    """What sessions learnt from attempts: (session, node, rate, accepted) each."""
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
    graph=None,
    paths=(),
    candidates=(),
    along_m=None,
    observed=(),
    outcomes=(),
    reference=None,
    own_path=None,
    focal_px=256.0,
    stamp_ns=0,
    seed=0,
    sessions=1,
    run=(),
    hour=None,
    day=None,
    hours=None,
    words=None,
    live_words=None,
    lessons=(),
) -> RankingContext:
    """A context over dense indices; candidates stand 0.1 m apart unless told.

    Sessions take turns in saving nodes; `hours` is their hour of day, `words` what nodes show,
    `lessons` what they attempted: (session, node, rate, accepted) each.
    """
    along = 0.1 * np.arange(len(candidates)) if along_m is None else along_m
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


def attempts_of(contents: MapContents, session: SessionId) -> list[Attempt]:
    """The remembered attempts of one session as records."""
    made = contents.attempts
    place = next((at for at, one in enumerate(contents.sessions) if one.id == session), -1)
    return [
        Attempt(
            iteration=int(made.iteration[row]),
            reference=contents.nodes[made.reference[row]].id,
            node=contents.nodes[made.node[row]].id,
            along_m=float(made.along_m[row]),
            across_m=float(made.across_m[row]),
            yaw_rad=float(made.yaw_rad[row]),
            sigma_m=float(made.sigma_m[row]),
            sigma_yaw_rad=float(made.sigma_yaw_rad[row]),
            accepted=bool(made.accepted[row]),
            inliers=int(made.inliers[row]),
            rank=int(made.rank[row]),
            policy=made.policies[made.policy[row]],
        )
        for row in np.flatnonzero(made.session == place)
    ]
