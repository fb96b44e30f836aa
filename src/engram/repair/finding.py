"""Finds the wrong edges of a map: what the rest contradicts, and what nothing confirms."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import PUBLIC, check_bounds
from engram.errors import MapCorruptError
from engram.frontend.features import feature_kind
from engram.frontend.frontend import as_live
from engram.frontend.matching import Match, match_frames, pair_seed
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, LandmarkSource
from engram.graph.paths import PathMemory
from engram.graph.placing import AdjustConfig, Adjusted, Measured, Poses, adjust, chain_poses
from engram.monitor import QUIET, Monitor


@dataclass(frozen=True, slots=True, eq=False)
class Near:
    """A node near another one.

    Attributes:
        node: its dense index.
        way_m: length of the path to it along the edges, metres.
        root_from_node: its pose in the root's camera.
    """

    node: int
    way_m: float
    root_from_node: SE3


class Surroundings:
    """Walks along the measured edges of a graph: those that a camera or odometry measured.

    Args:
        usable: (E,) bool, edges that may be walked along, in the order of `graph.edges`.
    """

    def __init__(self, graph: ExperienceGraph, usable: NDArray[np.bool_]) -> None:
        self._edges = graph.edges
        self._ends = graph.edge_ends[:, ::-1]  # of a and b
        self._usable = usable
        self._at: list[list[int]] = [[] for _ in range(len(graph))]
        for row in np.flatnonzero(usable).tolist():
            for end in self._ends[row].tolist():
                self._at[end].append(row)

    def around(self, root: int, reach_m: float, without: int = -1) -> Iterator[Near]:
        """The nodes within a path length of a root, nearest first; the root itself comes first.

        Args:
            root: dense index.
            reach_m: longest path, metres.
            without: an edge that is not walked along.
        """
        queue: list[tuple[float, int, int]] = [(0.0, root, -1)]
        poses: dict[tuple[int, int], SE3] = {}
        known: dict[int, SE3] = {}
        while queue:
            way_m, node, row = heapq.heappop(queue)
            if node in known:
                continue
            known[node] = SE3.identity() if row < 0 else poses.pop((node, row))
            yield Near(node, way_m, known[node])
            for other in self._at[node]:
                if other == without:
                    continue
                a, b = self._ends[other].tolist()
                there, edge = (b if a == node else a), self._edges[other]
                length_m = way_m + max(edge.a_from_b.distance_m, 0.05)
                if there in known or length_m > reach_m:
                    continue
                step = edge.a_from_b if a == node else edge.a_from_b.inverse()
                poses[there, other] = known[node] @ step
                heapq.heappush(queue, (length_m, there, other))

    def connects(self, a: int, b: int, reach_m: float, without: int) -> bool:
        """Whether a path of at most `reach_m` leads from one node to another without an edge."""
        queue, known = [(0.0, a)], set[int]()
        while queue:
            way_m, node = heapq.heappop(queue)
            if node == b:
                return True
            if node in known:
                continue
            known.add(node)
            for row in self._at[node]:
                ends = self._ends[row]
                there = int(ends[1] if ends[0] == node else ends[0])
                length_m = way_m + max(self._edges[row].a_from_b.distance_m, 0.05)
                if row != without and there not in known and length_m <= reach_m:
                    heapq.heappush(queue, (length_m, there))
        return False


def is_measured(kind: EdgeKind) -> bool:
    """Whether an edge of this kind is a measurement of its own, not composed of others."""
    return kind in {EdgeKind.ODOMETRY, EdgeKind.MATCH, EdgeKind.TIE}


@dataclass(frozen=True, slots=True)
class RepairConfig:
    """Settings of `find_wrong_edges`."""

    adjust: AdjustConfig = field(default_factory=AdjustConfig)
    gross_m: Annotated[
        float,
        Meta(
            ge=0,
            description="disagreement with the rest of the map from which an edge is suspected, m; "
            "smaller errors do not lead a robot to another place",
        ),
        PUBLIC,
    ] = 2.0
    gross_rad: Annotated[
        float, Meta(ge=0, description="the same of its direction, rad"), PUBLIC
    ] = 0.25
    gross_chi2: Annotated[
        float, Meta(gt=0, description="the same in squared standard deviations")
    ] = 50.0
    cycle_m: Annotated[
        float,
        Meta(
            gt=0,
            description="length of another path between its ends up to which agreement with that "
            "path confirms an edge, m: odometry drifts by less than `gross_m` over it",
        ),
    ] = 40.0
    looks: Annotated[
        int, Meta(ge=1, description="pairs of nodes that are matched to judge one edge, at most")
    ] = 16
    look_within_m: Annotated[
        float, Meta(gt=0, description="greatest path length from an edge's ends to such nodes, m")
    ] = 20.0
    look_apart_m: Annotated[
        float, Meta(gt=0, description="distance at which two nodes show enough of the same, m")
    ] = 4.0
    look_rad: Annotated[
        float, Meta(gt=0, description="angle at which two nodes show enough of the same, rad")
    ] = 0.5
    look_every_m: Annotated[
        float, Meta(gt=0, description="least distance between nodes of two pairs, m")
    ] = 1.5
    agree_m: Annotated[
        float, Meta(gt=0, description="distance within which a match confirms an edge, m")
    ] = 0.7
    agree_rad: Annotated[
        float, Meta(gt=0, description="angle within which a match confirms an edge, rad")
    ] = 0.1
    agree_inliers: Annotated[
        int, Meta(ge=0, description="fewest inliers of a match that confirms an edge")
    ] = 10
    odometry_inliers: Annotated[
        int,
        Meta(
            ge=0,
            description="inliers of a match of its own ends from which a step of odometry is right "
            "whatever contradicts it: more than look-alikes reach",
        ),
    ] = 60
    match_inliers: Annotated[int, Meta(ge=0, description="the same of a match or a tie")] = 100
    least_failing_looks: Annotated[
        int,
        Meta(
            ge=0,
            description="second looks that must disagree with a tie or a step of odometry that the "
            "rest of the map contradicts, before it is wrong",
        ),
    ] = 3
    most_unseen: Annotated[
        float, Meta(description="greatest surety of such an edge with fewer second looks")
    ] = 0.95
    contradicted_surety: Annotated[
        float,
        Meta(description="surety that an edge contradicted by the rest of the map is wrong"),
    ] = 1.8
    alone_surety: Annotated[float, Meta(description="surety that an unconfirmed edge is wrong")] = (
        0.85
    )
    tie_surety: Annotated[
        float,
        Meta(description="surety subtracted for a tie: a localised robot made it, and drove on"),
    ] = 0.5
    doubtful: Annotated[
        float, Meta(description="surety from which an edge is listed as doubtful")
    ] = 0.7
    per_failing_look: Annotated[
        float, Meta(ge=0, description="surety that each disagreeing second look adds")
    ] = 0.1
    most_by_looks: Annotated[
        float, Meta(ge=0, description="greatest surety that such looks add together")
    ] = 0.8
    per_look: Annotated[
        float, Meta(ge=0, description="surety that each agreeing second look subtracts")
    ] = 0.15
    per_fix: Annotated[
        float,
        Meta(
            ge=0,
            description="surety that each fix of a drive across the edge subtracts, of five at "
            "most",
        ),
    ] = 0.2

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True, eq=False)
class Suspicion:
    """How the edges of a graph agree with each other, by index in `graph.edges`.

    Attributes:
        off_m, off_rad: (E,) float64, disagreement with the adjusted map.
        chi2: (E,) float64, the same squared, in units of its variance.
        measured: (E,) bool, edges that are measurements.
        contradicted: (E,) bool, measurements that the rest of the map contradicts.
        confirmed: (E,) bool, measurements that a short other path between their ends confirms.
        poses: the adjusted map.
    """

    off_m: NDArray[np.float64]
    off_rad: NDArray[np.float64]
    chi2: NDArray[np.float64]
    measured: NDArray[np.bool_]
    contradicted: NDArray[np.bool_]
    confirmed: NDArray[np.bool_]
    poses: Poses


def suspect(graph: ExperienceGraph, config: RepairConfig, gone: Collection[int] = ()) -> Suspicion:
    """Adjusts the whole map robustly, and reports the edges it contradicts or does not confirm.

    Args:
        gone: indices of edges that are left out.
    """
    edges = graph.edges
    ends = graph.edge_ends.astype(np.int64)[:, ::-1]
    measured = np.array([is_measured(edge.kind) for edge in edges], np.bool_)
    measured[list(gone)] = False
    used = measured | np.array([edge.kind is EdgeKind.BRIDGE for edge in edges], np.bool_)
    rows = np.flatnonzero(used)
    adjusted = _adjusted(graph, rows, ends, config)
    every = Measured.of(edges, ends, config.adjust)
    error = every.residuals(adjusted.poses)
    off_m, off_rad = (np.linalg.norm(part, axis=1) for part in (error[:, :3], error[:, 3:]))
    chi2 = every.chi2(adjusted.poses)
    gross = (off_m > config.gross_m) | (off_rad > config.gross_rad)
    contradicted = measured & gross & (chi2 > config.gross_chi2)
    confirmed = np.zeros(len(edges), np.bool_)
    trusted = Surroundings(graph, used & ~contradicted)
    for row in np.flatnonzero(measured & ~contradicted).tolist():
        a, b = ends[row].tolist()
        confirmed[row] = trusted.connects(a, b, config.cycle_m, without=row)
    return Suspicion(off_m, off_rad, chi2, measured, contradicted, confirmed, adjusted.poses)


def _adjusted(
    graph: ExperienceGraph,
    rows: NDArray[np.intp],
    ends: NDArray[np.int64],
    config: RepairConfig,
) -> Adjusted:
    edges = [graph.edges[row] for row in rows.tolist()]
    poses, roots = chain_poses(edges, ends[rows], len(graph))
    free = np.ones(len(graph), np.bool_)
    free[roots] = False
    measured = Measured.of(edges, ends[rows], config.adjust)
    return adjust(poses, measured, free, config.adjust)


def part_labels(ends: NDArray[np.integer], count: int) -> NDArray[np.int32]:
    """(N,) int32: the component of each node, joined by edges with these ends (E, 2)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = ends.T
    links = coo_matrix((np.ones(len(ends)), (a, b)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], np.int32)


# Entries of a path that count on each side.
_LOOK = 8


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """The walks of all drives through experience space.

    Attributes:
        walks: for each path its nodes in order, (n,) int64, dense indices.
    """

    walks: tuple[NDArray[np.int64], ...]

    @staticmethod
    def of(graph: ExperienceGraph, paths: PathMemory) -> Crossings:
        """The walks of a map."""
        return Crossings(
            tuple(
                np.array([graph.index(entry.node) for entry in paths.entries(path)], np.int64)
                for path in paths.paths
            )
        )

    def witnessed(
        self, side_a: Collection[int], side_b: Collection[int], count: int, pause: int
    ) -> int:
        """How well the best drive that crossed from one side to the other was at home on both.

        Args:
            side_a, side_b: nodes near one end of an edge, and near the other.
            pause: entries of a path from its last on one side to its first on the other, at most.

        Returns:
            The number of different nodes by which it was localised, or that it saved, just before
            and just after; of the two the smaller. 0 if no drive crossed.
        """
        on = np.zeros((2, count), np.bool_)
        for side, nodes in enumerate((side_a, side_b)):
            on[side, list(nodes)] = True
        on &= ~on.all(axis=0)
        best = 0
        for walk in self.walks:
            on_walk = on[:, walk]
            sides = np.flatnonzero(on_walk.any(axis=0))
            second = on_walk[1, sides]
            changes = np.flatnonzero(second[1:] != second[:-1])
            for at in changes.tolist():
                last, first = int(sides[at]), int(sides[at + 1])
                if first - last > pause:
                    continue
                before = walk[max(last - _LOOK, 0) : last + 1]
                after = walk[first : first + _LOOK + 1]
                side = int(second[at])
                counts = (
                    len(np.unique(before[on[side, before]])),
                    len(np.unique(after[on[1 - side, after]])),
                )
                best = max(best, min(counts))
        return best


@dataclass(frozen=True, slots=True)
class Look:
    """One pair of nodes that was matched to judge an edge.

    Attributes:
        a, b: dense indices of the nodes.
        way_m: path length from the edge's ends to the nodes, the longer of the two, metres.
        apart_m: how far they lie apart, if the edge is right.
        inliers: of the match, 0 without one.
        off_m, off_rad: how far the match lies from what the edge says; infinite without one.
    """

    a: int
    b: int
    way_m: float
    apart_m: float
    inliers: int
    off_m: float
    off_rad: float


class SecondLooks:
    """Matches the nodes around the ends of edges."""

    def __init__(
        self,
        graph: ExperienceGraph,
        frames: LandmarkSource,
        surroundings: Surroundings,
        config: RepairConfig,
    ) -> None:
        self._graph = graph
        self._frames = frames
        self._surroundings = surroundings
        self._config = config

    def at(self, row: int) -> list[Look]:
        """The looks at an edge, the one at its own ends first.

        Args:
            row: its index in `graph.edges`.
        """
        edge = self._graph.edges[row]
        a, b = self._graph.index(edge.a), self._graph.index(edge.b)
        sides = [
            list(self._surroundings.around(end, self._config.look_within_m, without=row))
            for end in (a, b)
        ]
        return [self._look(near, other, pose) for near, other, pose in self._pairs(edge, *sides)]

    def _pairs(
        self, edge: Edge, side_a: Sequence[Near], side_b: Sequence[Near]
    ) -> list[tuple[Near, Near, SE3]]:
        """Pairs that should show the same things if the edge is right, spaced along the drives."""
        config = self._config
        pairs: list[tuple[float, Near, Near, SE3]] = []
        for a in side_a:
            node_from_b = a.root_from_node.inverse() @ edge.a_from_b
            for b in side_b:
                apart = node_from_b @ b.root_from_node
                if apart.distance_m <= config.look_apart_m and apart.angle_rad <= config.look_rad:
                    pairs.append((max(a.way_m, b.way_m), a, b, apart))
        pairs.sort(key=lambda pair: (pair[0], pair[1].node, pair[2].node))
        chosen: list[tuple[Near, Near, SE3]] = []
        for _, a, b, apart in pairs:
            if all(
                _separate(a, kept[0], config.look_every_m)
                or _separate(b, kept[1], config.look_every_m)
                for kept in chosen
            ):
                chosen.append((a, b, apart))
            if len(chosen) == config.looks:
                break
        return chosen

    def _look(self, a: Near, b: Near, a_from_b: SE3) -> Look:
        ids = [self._graph.node(near.node).id for near in (a, b)]
        try:
            reference, live = self._frames.frame(ids[0]), as_live(self._frames.frame(ids[1]))
            matcher = feature_kind(live.descriptor).matcher
            match = match_frames(reference, live, matcher, pair_seed(ids[1], ids[0]))
        except MapCorruptError:
            match = Match(None, None, 0, *(np.empty(0, np.int32),) * 2)
        way_m = max(a.way_m, b.way_m)
        off_m = off_rad = float("inf")
        if match.reference_from_live is not None:
            off = a_from_b.inverse() @ match.reference_from_live
            off_m, off_rad = off.distance_m, off.angle_rad
        return Look(a.node, b.node, way_m, a_from_b.distance_m, match.inliers, off_m, off_rad)


def _separate(near: Near, other: Near, every_m: float) -> bool:
    return (near.root_from_node.inverse() @ other.root_from_node).distance_m >= every_m


# Way from the ends of a wrong edge within which edges were predicted through it, metres.
_BESIDE_M = 12.0
# Entries of a path within which a drive crosses an edge: a tie leads from a match to a node saved
# some frames later; both ends of a match were seen at once, and over more entries a drive goes from
# one look-alike to the next without it.
_PAUSES = {EdgeKind.TIE: 8}


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """An edge that is probably wrong, with the evidence.

    Attributes:
        row: its index in the graph's edges.
        why: `contradicted` by the rest of the map, `alone`: nothing confirms it, or `derived`
            from edges that are.
        off_m, off_rad: disagreement with the rest of the map; 0 where nothing else constrains it.
        sigma_m: the standard deviation that the edge claims, metres.
        confirming, looks: pairs of nodes around it that match as it says, of those tried.
        witnessed: fixes of the best drive that crossed it, on the weaker side.
        surety: how surely it is wrong; 1 and more is certain enough to remove it.
    """

    edge: Edge
    row: int
    why: str
    off_m: float
    off_rad: float
    chi2: float
    sigma_m: float
    confirming: int
    looks: int
    inliers: int
    witnessed: int
    surety: float

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "a": str(self.edge.a),
            "b": str(self.edge.b),
            "kind": str(self.edge.kind),
            "why": self.why,
            "off_m": round(self.off_m, 2),
            "off_deg": round(float(np.rad2deg(self.off_rad)), 1),
            "sigma_m": round(self.sigma_m, 3),
            "sigmas": round(float(np.sqrt(self.chi2)), 1),
            "confirming": self.confirming,
            "looks": self.looks,
            "inliers": self.inliers,
            "witnessed": self.witnessed,
            "surety": round(self.surety, 2),
        }

    def text(self) -> str:
        """One line for people."""
        ends = f"{self.edge.kind:9} {str(self.edge.a)[:8]} → {str(self.edge.b)[:8]}"
        if self.why == "derived":
            return f"{ends}  follows from wrong edges, {self.off_m:.1f} m off"
        looks = f"{self.confirming} of {self.looks} second looks agree"
        if self.why == "contradicted":
            return (
                f"{ends}  {self.off_m:.1f} m off the rest of the map "
                f"({np.sqrt(self.chi2):.0f} σ); {looks}"
            )
        return f"{ends}  the only link of its kind; {looks}, {self.inliers} inliers"


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """Result of a search.

    Attributes:
        wrong: edges to remove, the surest first.
        doubtful: edges that something speaks against, and too little.
        examined: edges that were looked at once more, of all.
    """

    wrong: tuple[Finding, ...]
    doubtful: tuple[Finding, ...]
    examined: int
    of_edges: int


def find_wrong_edges(
    graph: ExperienceGraph,
    paths: PathMemory,
    frames: LandmarkSource,
    config: RepairConfig | None = None,
    monitor: Monitor = QUIET,
) -> Findings:
    """Finds the edges of a map that join what does not belong together.

    The whole map is adjusted robustly: edges that then lie far off contradict it. Other edges are
    confirmed by a short second path between their ends. What neither contradicts nor confirms, such
    as the only link between two components, is looked at again: nodes around both ends are matched,
    and drives that crossed it are counted.
    """
    config = config or RepairConfig()
    crossings = Crossings.of(graph, paths)
    gone: dict[int, Finding] = {}
    while True:
        search = _Search(graph, crossings, frames, config, gone)
        findings = search.findings(monitor)
        alone = [finding for finding in findings if finding.surety >= 1 and finding.why == "alone"]
        if not alone:
            return search.report(findings)
        # In a single cycle any edge may be to blame: without the edges that nothing confirms
        # others may no longer be contradicted.
        gone |= {finding.row: finding for finding in alone}


class _Search:
    """One round of the search, without the edges that earlier rounds found wrong."""

    def __init__(
        self,
        graph: ExperienceGraph,
        crossings: Crossings,
        frames: LandmarkSource,
        config: RepairConfig,
        gone: Mapping[int, Finding],
    ) -> None:
        self._graph, self._crossings, self._frames = graph, crossings, frames
        self._config, self._gone = config, gone
        self._suspicion = suspect(graph, config, gone)
        trusted = self._suspicion.measured & ~self._suspicion.contradicted
        trusted[list(gone)] = False
        self._trusted = Surroundings(graph, trusted)

    def findings(self, monitor: Monitor) -> list[Finding]:
        suspicion = self._suspicion
        monitor.check()
        odometry = np.array(
            [edge.kind is EdgeKind.ODOMETRY for edge in self._graph.edges], np.bool_
        )
        alone = suspicion.measured & ~suspicion.confirmed & ~suspicion.contradicted & ~odometry
        rows = np.flatnonzero(suspicion.contradicted | alone).tolist()
        looks = SecondLooks(self._graph, self._frames, self._trusted, self._config)
        found = []
        with monitor.stage("second looks", len(rows)) as stage:
            for row in rows:
                if row not in self._gone:
                    found.append(self._finding(row, looks.at(row)))
                stage.advance()
                stage.check()
        return found

    def report(self, findings: Sequence[Finding]) -> Findings:
        """Result of the rounds; `found` is of this, the last one."""
        wrong = [*self._gone.values(), *(finding for finding in findings if finding.surety >= 1)]
        wrong += self._derived(wrong)
        doubtful = [finding for finding in findings if self._config.doubtful <= finding.surety < 1]
        examined = len(self._gone) + len(findings)
        return Findings(_ranked(wrong), _ranked(doubtful), examined, len(self._graph.edges))

    def _finding(self, row: int, looks: Sequence[Look]) -> Finding:
        suspicion, edge = self._suspicion, self._graph.edges[row]
        own = next((look for look in looks if look.way_m == 0), None)
        others = [look for look in looks if look.way_m > 0]
        confirming = sum(map(self._confirms, others))
        contradicted = bool(suspicion.contradicted[row])
        witnessed = 0 if contradicted else self._witnessed(row, edge)
        return self._finding_of(
            row,
            "contradicted" if contradicted else "alone",
            self._surety(edge.kind, contradicted, confirming, len(others), witnessed)
            - self._by_own_match(edge, own),
            confirming=confirming,
            looks=len(others),
            inliers=0 if own is None else own.inliers,
            witnessed=witnessed,
        )

    def _surety(
        self, kind: EdgeKind, contradicted: bool, confirming: int, looks: int, witnessed: int
    ) -> float:
        """How surely an edge is wrong, from what speaks for and against it."""
        config = self._config
        if contradicted:
            against = config.contradicted_surety - config.per_look * confirming
            # Where a map is bent, ties and steps of odometry are off that nothing else disproves.
            seen = kind is EdgeKind.MATCH or looks - confirming >= config.least_failing_looks
            return against if seen else min(against, config.most_unseen)
        failing = min(config.per_failing_look * (looks - confirming), config.most_by_looks)
        tied = config.tie_surety * (kind is EdgeKind.TIE)
        for_it = config.per_look * confirming + config.per_fix * min(witnessed, 5) + tied
        return config.alone_surety + failing - for_it

    def _by_own_match(self, edge: Edge, own: Look | None) -> float:
        """Surety that an edge loses whose two frames match as it says, better than look-alikes."""
        config = self._config
        odometry = edge.kind is EdgeKind.ODOMETRY
        needed = config.odometry_inliers if odometry else config.match_inliers
        strong = own is not None and own.inliers >= needed and self._confirms(own)
        return config.contradicted_surety * strong

    def _confirms(self, look: Look) -> bool:
        config = self._config
        return (
            look.inliers >= config.agree_inliers
            and look.off_m <= config.agree_m
            and look.off_rad <= config.agree_rad
        )

    def _witnessed(self, row: int, edge: Edge) -> int:
        reach_m, index = self._config.look_within_m, self._graph.index
        sides = [
            [near.node for near in self._trusted.around(index(end), reach_m, without=row)]
            for end in (edge.a, edge.b)
        ]
        pause = _PAUSES.get(edge.kind, 1)
        return self._crossings.witnessed(sides[0], sides[1], len(self._graph), pause)

    def _derived(self, wrong: Sequence[Finding]) -> list[Finding]:
        """Predicted edges near wrong ones that assert the same."""
        graph, config = self._graph, self._config
        derived: dict[int, Finding] = {}
        for finding in wrong:
            sides = [
                {near.node: near.root_from_node for near in self._trusted.around(end, _BESIDE_M)}
                for end in map(graph.index, (finding.edge.a, finding.edge.b))
            ]
            for node, a_from_node in sides[0].items():
                for edge, row in graph.numbered_edges_of(node):
                    ahead = graph.index(edge.a) == node
                    other = graph.index(edge.b if ahead else edge.a)
                    if edge.kind is not EdgeKind.PROXIMITY or other not in sides[1]:
                        continue
                    implied = a_from_node.inverse() @ finding.edge.a_from_b @ sides[1][other]
                    measured = edge.a_from_b if ahead else edge.a_from_b.inverse()
                    apart_m = (measured.inverse() @ implied).distance_m
                    off_m = float(self._suspicion.off_m[row])
                    if apart_m <= config.gross_m < off_m:
                        derived[row] = self._finding_of(row, "derived", surety=1.0)
        return list(derived.values())

    def _finding_of(self, row: int, why: str, surety: float, **evidence: int) -> Finding:
        suspicion, edge = self._suspicion, self._graph.edges[row]
        counts = dict.fromkeys(("confirming", "looks", "inliers", "witnessed"), 0) | evidence
        return Finding(
            edge=edge,
            row=row,
            why=why,
            off_m=float(suspicion.off_m[row]),
            off_rad=float(suspicion.off_rad[row]),
            chi2=float(suspicion.chi2[row]),
            sigma_m=float(np.sqrt(np.linalg.eigvalsh(edge.covariance[:3, :3])[-1])),
            surety=surety,
            **counts,
        )


def _ranked(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    return tuple(
        sorted(findings, key=lambda finding: (-finding.surety, -finding.off_m, finding.row))
    )
