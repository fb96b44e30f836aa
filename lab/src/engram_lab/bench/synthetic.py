"""A made-up place with a long history: the input on which the speed of ranking is measured."""

from __future__ import annotations

from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from engram.geometry.cameras import CameraId
from engram.graph.basin import MatchBasin
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Node, PathEntry, PathEntryKind, PathId, SessionId, node_id
from engram.graph.neighbourhood import Neighbourhood
from engram.graph.paths import Attempts, PathMemory
from engram.ranking.context import Background, RankingContext
from engram.ranking.lessons import Lessons
from engram.ranking.recent import Observations, RunAttempts

_CAMERA = CameraId("0" * 32)
# A lens whose basin holds the whole search radius: every candidate is to be scored.
_FOCAL_PX = 707.0
_PLACES = 24  # metres of road: 8 m about the robot, and what it attempted before
_LOOKS = 12  # kinds of weather and light; a path keeps to the experiences of its kind


class SyntheticPlace:
    """A stretch of road that many sessions drove, and contexts drawn from it."""

    def __init__(self, path_count: int, experiences: int = 60, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)
        self.graph = ExperienceGraph()
        for experience in range(experiences):
            session = SessionId(UUID(int=experience + 1))
            for metre in range(_PLACES):
                stamp_ns = metre * 10**9
                node = Node(node_id(session, stamp_ns), session, stamp_ns, _CAMERA, float(metre))
                self.graph.add_node(node)
        self._experiences = experiences
        self.memory = PathMemory(self.graph)
        paths = [PathId(UUID(int=(1 << 100) + path)) for path in range(path_count)]
        for path in paths:
            self._add_path(path)
        lessons = Lessons.learnt(self.graph, self.memory, paths, Attempts.none(), np.zeros(0))
        self._basin = MatchBasin.of(_FOCAL_PX)
        self._background = Background(lessons=lessons)

    def _add_path(self, path: PathId) -> None:
        """At each metre a node of an experience of the path's look, now and then of another."""
        look = int(self._rng.integers(_LOOKS))
        alike = np.arange(look, self._experiences, _LOOKS)
        for metre in range(_PLACES):
            stray = self._rng.random() < 0.1
            experience = self._rng.integers(self._experiences) if stray else self._rng.choice(alike)
            node = self.graph.node(int(experience) * _PLACES + metre)
            self.memory.add(PathEntry(path, metre, node.id, PathEntryKind.MATCHED, metre * 10**9))

    def context(self, candidates: int = 200, observed: int = 1000) -> RankingContext:
        """A situation at random: |Y| candidates within 8 m, |W| nodes attempted lately."""
        everywhere = len(self.graph)
        nodes = np.sort(self._rng.choice(everywhere, candidates, replace=False)).astype(np.int32)
        attempted = self._rng.choice(everywhere, observed, replace=False).astype(np.int32)
        look = int(self._rng.integers(_LOOKS))
        succeeded = (attempted // _PLACES % _LOOKS == look) & (self._rng.random(observed) < 0.9)
        return RankingContext(
            neighbourhood=self._neighbourhood(nodes),
            graph=self.graph,
            path_memory=self.memory,
            basin=self._basin,
            observations=Observations(attempted, succeeded),
            reference=int(attempted[np.argmax(succeeded)]),
            own_path=self.memory.paths[0] if self.memory.paths else None,
            stamp_ns=0,
            run=self._run(attempted, succeeded),
            hour=12.0,
            background=self._background,
        )

    def _run(self, attempted: NDArray[np.int32], succeeded: NDArray[np.bool_]) -> RunAttempts:
        """The attempts four to a frame, frames 0.7 m apart, the last one just made."""
        count = len(attempted)
        at_m = -0.7 * (np.arange(count)[::-1] // 4).astype(np.float64)
        rates = self._rng.uniform(0.2, 0.95, count)
        landmarks = np.full(count, 300)
        distance_m = self._rng.uniform(0, 7.5, count)
        return RunAttempts(
            0.0, at_m, attempted, distance_m, rates, succeeded, 90 * succeeded, landmarks
        )

    def _neighbourhood(self, nodes: NDArray[np.int32]) -> Neighbourhood:
        along = self._rng.uniform(-7.5, 7.5, len(nodes))
        across = self._rng.uniform(-0.5, 0.5, len(nodes))
        poses = np.tile(np.eye(4), (len(nodes), 1, 1))
        poses[:, 2, 3], poses[:, 0, 3] = along, across
        sigma = np.full(len(nodes), 0.1)
        zeros = np.zeros(len(nodes))
        pivots = np.zeros((len(nodes), 3))
        distance = np.sqrt(along**2 + across**2)  # unlike hypot's, its bits are the same everywhere
        return Neighbourhood(nodes, poses, distance, along, across, zeros, sigma, sigma, pivots)
