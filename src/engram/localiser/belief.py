"""Where a lost robot may be, judged by several frames: a Bayes filter over the nodes of a graph.

One frame may look like several places; several frames along a stretch of road seldom do. The filter
adds each frame's evidence to that of earlier frames, which odometry carries along the edges of the
graph. A failed match attempt counts against its node and the nodes next to it. The filter keeps the
best explanation of each node (Viterbi), not the sum over all: a sum over paths would favour nodes
with many edges. It only orders the attempts; a match decides.

Evidence is measured in standard deviations over all nodes. FAB-MAP treats neighbouring features as
independent, so its log-likelihoods differ by hundreds between places: unscaled, the first frame
would decide alone.

Source: method §6; Cummins & Newman, FAB-MAP, IJRR 27(6), 2008, §4.6 carries the belief by a motion
model between neighbouring places in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3
from engram.graph.graph import ExperienceGraph, HalfEdges

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BeliefConfig:
    """Settings of `PlaceBelief`.

    Attributes:
        step_m: distance after which the belief moves along the edges, metres. Evidence in between
            is weighted by distance, so that a standing robot gains none. Source: the spacing of
            saved nodes.
        slack_m: standard deviation of the distance between a robot and the node it matches, metres.
        reach_m: longest edge that counts as a step, metres.
        leap: largest deficit of a node against the best one, for places that no edge leads to.
        refuted: cost of a failed attempt to its node.
        refuted_beside: cost of a failed attempt to each node joined to it by an edge.
    """

    step_m: float = 1.0
    slack_m: float = 1.0
    reach_m: float = 5.0
    leap: float = 8.0
    refuted: float = 2.0
    refuted_beside: float = 0.5


class PlaceBelief:
    """Adds up the evidence of live frames for each node of a graph.

    Args:
        graph: the experience graph; may grow between calls.
        config: settings.
    """

    def __init__(self, graph: ExperienceGraph, config: BeliefConfig | None = None) -> None:
        self.config = config or BeliefConfig()
        self._graph = graph
        self._steps: HalfEdges | None = None
        self.forget()

    def forget(self) -> None:
        """Discards the evidence of earlier frames."""
        self._belief: Array = np.zeros(0)
        self._moved_m: Array = np.zeros(3)
        self._since_m = np.inf

    def carry_on(self, motion: SE3 | None) -> None:
        """Moves the belief by `motion`, prev_from_curr; None, if unknown, discards it."""
        if motion is None:
            self.forget()
        elif len(self._belief):
            self._moved_m = self._moved_m + motion.translation
            self._since_m += motion.distance_m
            if math.sqrt(self._moved_m @ self._moved_m) >= self.config.step_m:
                self._carry()

    def observe(self, evidence: Array) -> Array:
        """Adds the evidence of one frame.

        Args:
            evidence: (N,) float64, score of the frame at each node, on any linear scale.

        Returns:
            (N,) float64, the likelihood of each node: log-probabilities up to scale and constant.
        """
        spread = float(evidence.std()) if len(evidence) else 0.0
        scaled = (evidence - evidence.mean()) / spread if spread > 0 else np.zeros_like(evidence)
        self._belief = self._of_all(len(evidence))
        weight = min(1.0, self._since_m / self.config.step_m)
        now: Array = self._belief + scaled
        self._belief = self._belief + weight * scaled
        self._since_m = 0.0
        return now

    def refute(self, nodes: Sequence[int]) -> None:
        """Counts failed attempts to match the last frame against these nodes, by dense index."""
        config = self.config
        for node in nodes:
            if node < len(self._belief):
                self._belief[node] -= config.refuted
                beside = self._graph.beside(node, config.reach_m)
                self._belief[beside[beside < len(self._belief)]] -= config.refuted_beside

    def _of_all(self, count: int) -> Array:
        """The belief, extended by new nodes of the graph at its minimum."""
        new = count - len(self._belief)
        least = self._belief.min(initial=0.0)
        return np.concatenate([self._belief, np.full(new, least)]) if new else self._belief

    def _carry(self) -> None:
        """Moves the belief along the edges, in steps about as long as they are."""
        steps = self._edges()
        moved_m = math.sqrt(self._moved_m @ self._moved_m)
        count = max(1, round(moved_m / self.config.step_m))
        motion = self._moved_m / count
        off = ((steps.target_in_source - motion) ** 2).sum(axis=1)
        cost = off / (2 * self.config.slack_m**2)
        stay = float(motion @ motion) / (2 * self.config.slack_m**2)
        for _ in range(count):
            carried = self._belief - stay
            np.maximum.at(carried, steps.targets, self._belief[steps.sources] - cost)
            self._belief = np.maximum(carried, self._belief.max() - self.config.leap)
        self._moved_m = np.zeros(3)

    def _edges(self) -> HalfEdges:
        """Edges short enough to be steps, between nodes that the belief covers."""
        if self._steps is None or self._steps.of_edges != len(self._graph.edges):
            self._steps = self._graph.half_edges(self.config.reach_m)
        known = len(self._belief)
        rows = (self._steps.sources < known) & (self._steps.targets < known)
        return self._steps if rows.all() else self._steps.rows(rows)
