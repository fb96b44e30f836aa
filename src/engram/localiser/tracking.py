"""The position of a robot, carried on by odometry between matches.

Fuses a weak match with the position predicted from earlier matches. In rain a match of few
landmarks may be decimetres off, sometimes a metre, while odometry has carried the last match on
with less error. The reported position is then the mean of both, weighted by their covariances, as
in a Kalman filter on SE(3) with errors to the left (Barfoot, State Estimation for Robotics, 2017,
§7.3). A match of many landmarks needs no help: on real drives odometry is no more exact, and errs
the same way at each step. Candidates, predictions and the edges of a map rest on matches alone, so
that what these measure counts once.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import NodeId
from engram.localiser.localisation import Position


class Follower(Protocol):
    """What keeps positions and carries them on by the robot's motion."""

    def carry_on(self, prev_from_curr: SE3, covariance: NDArray[np.float64]) -> None:
        """Carries all positions on by the robot's motion.

        Args:
            prev_from_curr: pose of this frame in the one before.
            covariance: (6, 6) float64 of that pose, left perturbation, [translation in m,
                rotation in rad].
        """
        ...


class Track:
    """The position of a robot; a `Follower`.

    Args:
        earlier_doubt: see `LocaliserConfig`.
        greatest_gap_m: largest standard deviation of guessed motion at which it is certain, metres.

    Attributes:
        measured: by the last match, saved node or caller; None if unknown.
        best: by the matches before it, too.
        guessed_m2: variance of the motion guessed since the last match or saved node, m².
    """

    def __init__(
        self, graph: ExperienceGraph, earlier_doubt: float, greatest_gap_m: float = math.inf
    ) -> None:
        self._graph = graph
        self._earlier_doubt = earlier_doubt
        self._greatest_gap_m2 = greatest_gap_m**2
        self.measured: Position | None = None
        self.best: Position | None = None
        self.guessed_m2 = 0.0

    @property
    def certain(self) -> bool:
        """Whether the position is known: odometry since the last match had only short gaps."""
        return self.measured is not None and self.guessed_m2 <= self._greatest_gap_m2

    def set(self, position: Position | None) -> None:
        """Sets the position, whatever it was before."""
        self.measured = self.best = position

    def carry_on(self, prev_from_curr: SE3, covariance: NDArray[np.float64]) -> None:
        """See `Follower`."""
        measured, best = self.measured, self.best
        if measured is None or best is None:
            return
        self.measured = measured.carried_on(prev_from_curr, covariance)
        one = best is measured
        self.best = self.measured if one else best.carried_on(prev_from_curr, covariance)

    def best_after(self, ahead: tuple[SE3, NDArray[np.float64]] | None) -> Position | None:
        """The best position; at an unusable frame carried on by a guess, and less certain.

        Args:
            ahead: motion that is guessed since, and its (6, 6) float64 covariance, left
                perturbation, [translation in m, rotation in rad].
        """
        return self.best if self.best is None or ahead is None else self.best.carried_on(*ahead)

    def fix(self, matched: Position, *, leans: bool) -> None:
        """The newest match.

        Args:
            leans: whether it is weak, and earlier ones led to expect it.
        """
        before, self.measured, self.best = self.best, matched, matched
        self.guessed_m2 = 0.0
        if before is None or not leans or not self._earlier_doubt:
            return
        there = seen_from(self._graph, matched.node, before)
        if there is not None:
            self.best = fused(there, matched, self._earlier_doubt)


def seen_from(graph: ExperienceGraph, node: NodeId, position: Position) -> Position | None:
    """A position as it is seen from another node; None if no edges join the two."""
    known = graph.predict(graph.index(node), graph.index(position.node))
    if known is None:
        return None
    return Position(node, *known).carried_on(position.node_from_live, position.covariance)


def fused(expected: Position, matched: Position, doubt: float) -> Position:
    """The position by both.

    Matches that follow each other are not independent: light moves the same landmarks, and the
    calibration is one. So what is expected counts less than its covariance says, and a robot that
    stands claims no more than `doubt / (doubt - 1)` matches' worth (a fading memory).

    Args:
        matched: the newest match, seen from the same node.
        doubt: by how much the covariance of `expected` is taken to be larger.
    """
    assert expected.node == matched.node
    doubted = doubt * expected.covariance
    gain = np.linalg.solve(doubted + matched.covariance, doubted).T
    apart = (matched.node_from_live @ expected.node_from_live.inverse()).log()
    covariance = doubted - gain @ doubted
    return Position(
        matched.node,
        SE3.exp(gain @ apart) @ expected.node_from_live,
        (covariance + covariance.T) / 2,
    )
