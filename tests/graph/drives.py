"""Simulated fleets on a closed route, with known truth: several sessions map it one by one."""

from dataclasses import dataclass, field

import numpy as np
from tests.builders import covariance_of

from engram.geometry.se3 import SE3, propagate_covariance
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind
from engram.graph.neighbourhood import Search
from engram.graph.proximity import lay_proximity_edges, tighten_chain
from engram.testing.contracts import make_node, session_uuid

GATE_RAD = np.deg2rad(60)
MATCH_BASIN_M = 2.0
MATCH_NOISE = (0.02, np.deg2rad(0.1))


@dataclass
class Route:
    """A closed course with two straights and bends, metres."""

    length_m: float

    def pose(self, s_m: float, across_m: float, backwards: bool) -> SE3:
        """world_from_cam at an arc length; `across_m` to the right of forward travel."""
        angle = 2 * np.pi * s_m / self.length_m
        scale = self.length_m / (2 * np.pi)
        # A closed curve whose curvature varies: radius modulated by a third harmonic.
        radius = scale * (1 + 0.08 * np.cos(3 * angle))
        slope = scale * -0.24 * np.sin(3 * angle)
        position = radius * np.array([np.cos(angle), 0, np.sin(angle)])
        tangent = slope * np.array([np.cos(angle), 0, np.sin(angle)]) + radius * np.array(
            [-np.sin(angle), 0, np.cos(angle)]
        )
        tangent /= np.linalg.norm(tangent)
        right = np.array([tangent[2], 0, -tangent[0]])
        forward = -tangent if backwards else tangent
        side = -right if backwards else right
        rotation = np.column_stack([side, [0, 1, 0], forward])
        return SE3(rotation, position + across_m * right)


@dataclass
class Tally:
    """What was seen of what should have been, pooled over the positions of one session."""

    due: int = 0
    seen: int = 0
    predictions: int = 0
    honest: int = 0
    sigmas_m: list[float] = field(default_factory=list)
    saved: int = 0
    edges: int = 0


class Fleet:
    """Maps a route session by session, as the mapper does, attempting every candidate.

    Args:
        looks: looks(session, other, s_m): whether two sessions look alike at a place.
        sigma: standard deviation of odometry per step of 1 m: metres and radians per axis.
    """

    def __init__(self, route: Route, looks, sigma, seed: int) -> None:
        self.route, self.looks, self.sigma = route, looks, sigma
        self.rng = np.random.default_rng(seed)
        self.graph = ExperienceGraph()
        self.truth: list[SE3] = []
        self.positions, self.rotations = np.zeros((20_000, 3)), np.zeros((20_000, 3, 3))

    def drive(self, session: int, start_m: float, metres: int, across_m: float, backwards: bool):
        """Drive and map; returns the tally of the session."""
        drive = _Drive(self, session, start_m, across_m, backwards)
        for step in range(metres):
            drive.step(step)
        return drive.tally


class _Drive:
    def __init__(self, fleet: Fleet, session: int, start_m, across_m, backwards) -> None:
        self.fleet, self.session = fleet, session
        self.start_m, self.across_m, self.backwards = start_m, across_m, backwards
        self.phase = fleet.rng.uniform(0, 2 * np.pi)
        self.chain: list[int] = []
        self.reference = self._seed()
        self.tally = Tally()

    def place(self, step: int) -> float:
        return self.start_m + (-step if self.backwards else step)

    def pose(self, step: int) -> SE3:
        sway = 0.5 * np.sin(2 * np.pi * step / 70 + self.phase)
        return self.fleet.route.pose(self.place(step), self.across_m + sway, self.backwards)

    def _seed(self) -> int | None:
        """Starts at the node nearest by truth, as an evaluation does; none in an empty map."""
        if len(self.fleet.graph) == 0:
            return None
        world_from_live = self.pose(0)
        positions = self.fleet.positions[: len(self.fleet.graph)]
        nearest = int(np.argmin(np.linalg.norm(positions - world_from_live.translation, axis=1)))
        self.reference_from_live = self.fleet.truth[nearest].inverse() @ world_from_live
        self.covariance = covariance_of(*MATCH_NOISE)
        return nearest

    def step(self, step: int) -> None:
        world_from_live = self.pose(step)
        if step > 0:
            self._dead_reckon(self.pose(step - 1).inverse() @ world_from_live)
        matched = None
        if self.reference is not None:
            near = self._neighbourhood(step)
            self._judge(step, near, world_from_live)
            matched = self._match(step, near.nodes[np.argsort(near.distance_m)], world_from_live)
            if matched is None and self.chain:
                matched = self._match(step, self._places(step, world_from_live), world_from_live)
        if matched is not None:
            self._localised(matched, world_from_live)
        else:
            self._save(step, world_from_live)

    def _dead_reckon(self, prev_from_live: SE3) -> None:
        sigma = [self.fleet.sigma[0]] * 3 + [self.fleet.sigma[1]] * 3
        noise = SE3.exp(self.fleet.rng.normal(0, sigma))
        self.covariance = propagate_covariance(
            self.reference_from_live, self.covariance, np.diag(np.square(sigma))
        )
        self.reference_from_live = self.reference_from_live @ (noise @ prev_from_live)

    def _neighbourhood(self, step: int):
        sigma_m = np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1])
        return self.fleet.graph.neighbourhood(
            self.reference,
            self.reference_from_live,
            self.covariance,
            Search(
                max(8.0, MATCH_BASIN_M + 2 * sigma_m),
                GATE_RAD,
                own_session=session_uuid(self.session),
                own_driven_m=float(step),
            ),
        )

    def _judge(self, step: int, near, world_from_live: SE3) -> None:
        """Which nodes are truly within 8 m and the gate, and which of them were found."""
        fleet, tally, count = self.fleet, self.tally, len(self.fleet.graph)
        offsets = world_from_live.translation - fleet.positions[:count]
        headings = fleet.rotations[:count].transpose(0, 2, 1) @ world_from_live.rotation
        yaw = np.arctan2(headings[:, 0, 2], headings[:, 2, 2])
        due = (np.linalg.norm(offsets, axis=1) <= 8.0) & (np.abs(yaw) <= GATE_RAD)
        due &= ~self._own_recent(step)
        tally.due += int(due.sum())
        tally.seen += int(due[near.nodes].sum())
        in_nodes = np.einsum("nji,nj->ni", fleet.rotations[near.nodes], offsets[near.nodes])
        errors_m = np.linalg.norm(near.node_from_live[:, :3, 3] - in_nodes, axis=1)
        tally.predictions += len(near)
        tally.honest += int((errors_m <= 3 * near.sigma_m).sum())
        tally.sigmas_m.extend(near.sigma_m.tolist())

    def _own_recent(self, step: int):
        graph = self.fleet.graph
        own = graph.sessions == graph.session_number(session_uuid(self.session))
        return own & (step - graph.driven_m < 30)

    def _places(self, step: int, world_from_live: SE3):
        """What place recognition finds while saving (method §5): large loops close by it."""
        positions = self.fleet.positions[: len(self.fleet.graph)]
        offsets = np.linalg.norm(positions - world_from_live.translation, axis=1)
        return np.flatnonzero((offsets < MATCH_BASIN_M) & ~self._own_recent(step))

    def _match(self, step: int, nodes, world_from_live: SE3):
        """The first node that looks alike and truly is within the basin."""
        for node in nodes.tolist():
            other = int(self.fleet.graph.sessions[node])
            node_from_live = self.fleet.truth[node].inverse() @ world_from_live
            if (
                node_from_live.distance_m < MATCH_BASIN_M
                and abs(node_from_live.yaw_rad) < 0.5
                and self.fleet.looks(self.session, other, self.place(step))
            ):
                return node
        return None

    def _localised(self, node: int, world_from_live: SE3) -> None:
        fleet = self.fleet
        sigma = [MATCH_NOISE[0]] * 3 + [MATCH_NOISE[1]] * 3
        measured = SE3.exp(fleet.rng.normal(0, sigma)) @ (
            fleet.truth[node].inverse() @ world_from_live
        )
        if self.chain:
            # The live frame is a metre past the last saved node: go back by the odometry since.
            last_from_live = self.reference_from_live
            node_from_last = measured @ last_from_live.inverse()
            covariance = propagate_covariance(
                node_from_last, covariance_of(*MATCH_NOISE), self.covariance
            )
            last = fleet.graph.node(self.chain[-1]).id
            tie = Edge(fleet.graph.node(node).id, last, EdgeKind.TIE, node_from_last, covariance)
            fleet.graph.add_edge(tie)
            self.tally.edges += len(tighten_chain(fleet.graph, self.chain))
            self.chain = []
        self.reference, self.reference_from_live = node, measured
        self.covariance = np.diag(np.square(sigma))

    def _save(self, step: int, world_from_live: SE3) -> None:
        fleet = self.fleet
        record = make_node(self.session, step)
        index = fleet.graph.add_node(record)
        fleet.truth.append(world_from_live)
        fleet.positions[index] = world_from_live.translation
        fleet.rotations[index] = world_from_live.rotation
        self.tally.saved += 1
        if self.reference is not None:
            kind = EdgeKind.ODOMETRY if self.chain else EdgeKind.TIE
            before = fleet.graph.node(self.reference).id
            fleet.graph.add_edge(
                Edge(before, record.id, kind, self.reference_from_live, self.covariance)
            )
            self.tally.edges += len(lay_proximity_edges(fleet.graph, index))
        self.chain.append(index)
        self.reference = index
        self.reference_from_live, self.covariance = SE3.identity(), np.zeros((6, 6))
