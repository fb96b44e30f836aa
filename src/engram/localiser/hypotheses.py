"""Where a lost robot may be by matches that are not believed one by one.

They are too weak, or contradict where the robot believes to be: that speaks against strong ones
too. Such a match may be right, and it may be two cars that stand alike in two streets. Right ones
agree with each other while the robot drives on: the position of the first, carried on by odometry,
predicts where the second is found. So it waits, the nodes near it are attempted with the
frames to come, and when another match some way on agrees, that one is believed.

How far on depends on what a mistake costs. A robot that only localises finds out, and goes on. One
that is being mapped would join two places for good: it waits for a third match, and until it has
passed what the first one saw. When it has driven for long past what the map does not know, so does
a match that is strong enough to be believed by itself: the more places were compared, the likelier
is a look-alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from engram.experience.graph import ExperienceGraph
from engram.experience.neighbourhood import Neighbourhood
from engram.localiser.acceptance import AcceptanceConfig, Prediction, agrees
from engram.localiser.attempts import Outcome
from engram.localiser.localisation import Position
from engram.odometry import OdometryStep

# From places this far apart not the same two parked cars are seen alike; 2 m were not enough.
_BASE_LINE_M = 4.0
# Two corner houses of a kind are seen alike, from 30 m away on, over the 13 m in which a robot
# drives up to them.
_LONGEST_BASE_LINE_M = 20.0
# So many matches agree, the first one included, each of them a base line further on than the last.
_WITNESSES = 2
_WITNESSES_TO_JOIN = 3
# So far past its base line what a weak match saw is out of sight, and odometry has drifted.
_FORGOTTEN_AFTER_M = 11.0
# So many wait at a time; the oldest goes.
_MOST = 8
# A robot that maps and has been lost for longer believes no lone match, however strong.
_LONE_WITHIN_M = 20.0


def look_alikes_likely(lost_m: float) -> bool:
    """Whether a robot has been lost for too long to join places by one match, however strong."""
    return lost_m > _LONE_WITHIN_M


@dataclass(slots=True)
class _Hypothesis:
    position: Position
    base_line_m: float
    driven_m: float = 0.0
    witnesses: int = 1
    last_witness_m: float = 0.0

    def testify(self) -> None:
        """Another match agrees; it counts where it is far enough from the last one."""
        if self.driven_m >= self.last_witness_m + _BASE_LINE_M:
            self.witnesses += 1
            self.last_witness_m = self.driven_m


class Hypotheses:
    """Weak matches that wait for a second one.

    Args:
        graph: the experience graph.
        search: its `neighbourhood`, with what does not change filled in: the nodes near a position.
        acceptance: when two positions agree.
        joins: whether what is believed joins places for good: the robot is being mapped.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        search: Callable[[Position], Neighbourhood],
        acceptance: AcceptanceConfig,
        *,
        joins: bool = False,
    ) -> None:
        self._graph = graph
        self._joins = joins
        self._search = search
        self._acceptance = acceptance
        self._waiting: list[_Hypothesis] = []

    def forget(self) -> None:
        """The robot was found, or nobody knows how it moved."""
        self._waiting.clear()

    def carry_on(self, odometry: OdometryStep) -> None:
        """The robot moved on."""
        motion, covariance = odometry.prev_from_curr, odometry.covariance
        if motion is None or covariance is None:
            self.forget()
            return
        for one in self._waiting:
            one.position = one.position.carried_on(motion, covariance)
            one.driven_m += motion.distance_m
        self._waiting = [
            one for one in self._waiting if one.driven_m <= one.base_line_m + _FORGOTTEN_AFTER_M
        ]

    def nodes_near(self, count: int) -> list[int]:
        """Nodes, by dense index, that could confirm one of them, the nearest first."""
        nodes: list[int] = []
        for one in reversed(self._waiting):
            near = self._search(one.position)
            order = np.argsort(near.distance_m, kind="stable")[:count]
            nodes += [node for node in near.nodes[order].tolist() if node not in nodes]
        return nodes

    def judge(self, outcomes: list[Outcome]) -> list[Outcome]:
        """Accepts the plausible matches with which an earlier one agrees; the others wait.

        Args:
            outcomes: of this frame's attempts; where one was accepted already, nothing is to do.

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
            for one in agreeing:
                one.testify()
            if any(self._confirmed(one) for one in agreeing):
                confirmed.append(outcome)
            elif not agreeing:
                new = _Hypothesis(_position_of(outcome), self._base_line_m(outcome))
                expected.append((new, self._predictions(new.position)))
                self._waiting = [*self._waiting, new][-_MOST:]
        return [
            replace(outcome, accepted=True) if outcome in confirmed else outcome
            for outcome in outcomes
        ]

    def _confirmed(self, one: _Hypothesis) -> bool:
        enough = _WITNESSES_TO_JOIN if self._joins else _WITNESSES
        return one.witnesses >= enough and one.driven_m >= one.base_line_m

    def _base_line_m(self, outcome: Outcome) -> float:
        seen_m = outcome.depth_m if self._joins else 0.0
        return float(np.clip(seen_m, _BASE_LINE_M, _LONGEST_BASE_LINE_M))

    def _predictions(self, position: Position) -> dict[int, Prediction]:
        near = self._search(position)
        return {node: Prediction.of(near, row) for row, node in enumerate(near.nodes.tolist())}

    def _agree(self, outcome: Outcome, predictions: dict[int, Prediction]) -> bool:
        prediction = predictions.get(outcome.candidate.index)
        pose = outcome.match.reference_from_live
        assert pose is not None
        return prediction is not None and agrees(pose, prediction, self._acceptance)


def _position_of(outcome: Outcome) -> Position:
    pose, covariance = outcome.match.reference_from_live, outcome.match.covariance
    assert pose is not None
    assert covariance is not None
    return Position(outcome.candidate.node, pose, covariance)
