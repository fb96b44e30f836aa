"""Matches of a lost robot that need a second match to be accepted.

Such a match is too weak, or contradicts the estimated position. It may be correct, or two cars
parked alike in two streets. Correct matches agree with each other while the robot drives on: the
position of the first, carried on by odometry, predicts that of the second. So the match waits,
later frames attempt the nodes near it, and the next match that agrees with it is accepted. Of a
robot that found nothing for long, matches must agree one after another over a longer distance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.neighbourhood import Neighbourhood
from engram.localiser.acceptance import AcceptanceConfig, Prediction, agrees
from engram.localiser.attempts import Outcome
from engram.localiser.localisation import Position
from engram.localiser.settings import HypothesesConfig


@dataclass(slots=True)
class _Hypothesis:
    """A match that waits.

    Attributes:
        position: where it says the robot is now.
        driven_m: distance since the match.
        agreed_m: distance before it over which others agreed with it.
    """

    position: Position
    driven_m: float = 0.0
    agreed_m: float = 0.0

    def renew(self, position: Position) -> None:
        """Continues from a later match that agrees."""
        self.position = position
        self.agreed_m += self.driven_m
        self.driven_m = 0.0


class Hypotheses:
    """Weak matches that wait for a second one.

    Args:
        graph: the experience graph.
        search: finds the nodes near a position.
        acceptance: thresholds by which two positions agree.
        vague_m: standard deviation of a position beyond which agreement with it says nothing.
        config: how long they wait.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        search: Callable[[Position], Neighbourhood],
        acceptance: AcceptanceConfig,
        vague_m: float = 1.0,
        config: HypothesesConfig | None = None,
    ) -> None:
        self._graph = graph
        self._search = search
        self._acceptance = acceptance
        self._vague_m = vague_m
        self._config = config or HypothesesConfig()
        self._waiting: list[_Hypothesis] = []

    def forget(self) -> None:
        """Drops all: the robot was found."""
        self._waiting.clear()

    def carry_on(self, prev_from_curr: SE3, covariance: NDArray[np.float64]) -> None:
        """Carries all positions on by the robot's motion; drops those that became too vague.

        Args:
            prev_from_curr: pose of this frame in the one before.
            covariance: (6, 6) float64 of that pose, left perturbation, [translation in m,
                rotation in rad].
        """
        for one in self._waiting:
            one.position = one.position.carried_on(prev_from_curr, covariance)
            one.driven_m += prev_from_curr.distance_m
        self._waiting = [
            one
            for one in self._waiting
            if one.driven_m <= self._config.forgotten_after_m
            and one.position.sigma_m <= self._vague_m
        ]

    def nodes_near(self, count: int) -> list[int]:
        """Nodes, by dense index, that could confirm one: `count` for each, nearest first."""
        nodes: list[int] = []
        for one in reversed(self._waiting):
            near = self._search(one.position)
            order = np.argsort(near.distance_m, kind="stable")[:count]
            nodes += [node for node in near.nodes[order].tolist() if node not in nodes]
        return nodes

    def judge(self, outcomes: list[Outcome], witness: float = 0.0) -> list[Outcome]:
        """Accepts plausible matches that agree with an earlier one; the others wait.

        Args:
            outcomes: of this frame's attempts; returned unchanged if one is already accepted.
            witness: what agreement adds to the confidence of a match.

        Returns:
            The same outcomes, in their order.
        """
        found = [outcome for outcome in outcomes if outcome.plausible]
        if not found or any(outcome.accepted for outcome in outcomes):
            return outcomes
        expected = [(one, self._predictions(one.position)) for one in self._waiting]
        confirmed = []
        for outcome in found:
            agreeing = [one for one, near in expected if self._agree(outcome, near)]
            if any(one.agreed_m + one.driven_m >= self._needed_m(outcome) for one in agreeing):
                confirmed.append(outcome)
            elif not agreeing:
                new = _Hypothesis(outcome.position)
                expected.append((new, self._predictions(new.position)))
                self._waiting = [*self._waiting, new][-self._config.most :]
            for one in agreeing:
                if one.driven_m >= self._config.base_line_m:
                    one.renew(outcome.position)
        return [
            replace(outcome, accepted=True, confidence=outcome.confidence + witness)
            if outcome in confirmed
            else outcome
            for outcome in outcomes
        ]

    def _needed_m(self, outcome: Outcome) -> float:
        config = self._config
        return config.long_base_line_m if outcome.candidate.lost_long else config.base_line_m

    def _predictions(self, position: Position) -> dict[int, Prediction]:
        near = self._search(position)
        return {node: Prediction.of(near, row) for row, node in enumerate(near.nodes.tolist())}

    def _agree(self, outcome: Outcome, predictions: dict[int, Prediction]) -> bool:
        prediction = predictions.get(outcome.candidate.index)
        pose = outcome.match.reference_from_live
        assert pose is not None
        return prediction is not None and agrees(pose, prediction, self._acceptance)
