"""How far a position is confirmed: fixes on trial, chains of them, fused motion.

Keeps new fixes on trial until enough of them agree. A street repeats, and matches one period off
agree with each other for some metres. So the fixes since a robot was lost, or since its position
was set, are on trial. They settle once one of them is sure by itself, or once they have agreed over
some distance. A match that contradicts them before that withdraws them. If it comes later, the
robot was rather carried elsewhere.

The longer a drive stays disconnected, the more look-alike places it passes, some of them alike over
tens of metres. Fixes that join it must agree over a share of that distance, however sure one is.

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
from collections import deque

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import Frame
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import NodeId
from engram.localiser.acceptance import AcceptanceConfig, Prediction, agrees
from engram.localiser.attempts import Outcome
from engram.localiser.confidence import Record, Standing, confidence_of
from engram.localiser.localisation import Position

# A trial ends this far beyond the distance that settles it: nothing came that could contradict.
_PATIENCE_M = 20.0
# Newest fixes that may be withdrawn, and frames that wait for it: a robot may stand for hours on a
# weak match. Ten seconds at 20 Hz.
MOST_ON_TRIAL = 200


class FixChain:
    """The fixes that agree with each other, on trial until they settle.

    Args:
        sure_confidence: log-odds of one fix by itself that settle the chain.
        settle_after_m: distance between agreeing fixes that settles it, metres.
    """

    def __init__(self, sure_confidence: float, settle_after_m: float) -> None:
        self._limits = sure_confidence, settle_after_m
        self._sure, self._after_m = self._limits
        self._on_trial: deque[int] = deque(maxlen=MOST_ON_TRIAL)
        self._moved_m = 0.0
        self.position: Position | None = None

    @property
    def on_trial(self) -> bool:
        """Whether the newest fixes may still be withdrawn."""
        return bool(self._on_trial)

    def begin(
        self, stamp_ns: int, found: Position, alone: float, joins_after_m: float = 0.0
    ) -> tuple[int, ...]:
        """A fix that agrees with none before it; returns the stamps of those on trial.

        Args:
            stamp_ns: stamp of its frame.
            found: where it is.
            alone: its confidence without the fixes before it.
            joins_after_m: distance between agreeing fixes, metres, that joins two parts of a map.
                Where it is longer than what settles any chain, no single fix settles this one.
        """
        self._sure, self._after_m = self._limits
        if joins_after_m > self._after_m:
            self._sure, self._after_m = np.inf, joins_after_m
        before = tuple(self._on_trial)
        self._on_trial.clear()
        self._on_trial.append(stamp_ns)
        self._moved_m, self.position = 0.0, found
        if alone >= self._sure:
            self.settle()
        return before

    def join(self, stamp_ns: int, found: Position, alone: float) -> None:
        """A fix that agrees with those before it; see `begin`."""
        if not self._on_trial:
            return
        self._on_trial.append(stamp_ns)
        self.position = found
        if alone >= self._sure or self._moved_m >= self._after_m:
            self.settle()

    def carry_on(self, prev_from_curr: SE3, covariance: NDArray[np.float64]) -> None:
        """Carries the trial on by the robot's motion.

        Args:
            prev_from_curr: pose of this frame in the one before.
            covariance: (6, 6) float64 of that pose, left perturbation, [translation in m,
                rotation in rad].
        """
        if self.position is None:
            return
        self.position = self.position.carried_on(prev_from_curr, covariance)
        self._moved_m += prev_from_curr.distance_m
        if self._moved_m > self._after_m + _PATIENCE_M:
            self.settle()

    def settle(self) -> None:
        """The fixes stay, whatever comes."""
        self._on_trial.clear()
        self.position = None


class Track:
    """The position of a robot, carried on by odometry.

    Args:
        graph: joins the nodes that are matched.
        earlier_doubt: see `LocaliserConfig`.

    Attributes:
        measured: by the last match, saved node or caller; None if unknown.
        best: by the matches before it, too.
    """

    def __init__(self, graph: ExperienceGraph, earlier_doubt: float) -> None:
        self._graph = graph
        self._earlier_doubt = earlier_doubt
        self.measured: Position | None = None
        self.best: Position | None = None

    def set(self, position: Position | None) -> None:
        """Sets the position, whatever it was before."""
        self.measured = self.best = position

    def carry_on(self, prev_from_curr: SE3, covariance: NDArray[np.float64]) -> None:
        """Carries the position on by the robot's motion.

        Args:
            prev_from_curr: pose of this frame in the one before.
            covariance: (6, 6) float64 of that pose, left perturbation, [translation in m,
                rotation in rad].
        """
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
            matched: the position by it.
            leans: whether it is weak, and earlier ones led to expect it.
        """
        before, self.measured, self.best = self.best, matched, matched
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
        expected: what earlier matches and odometry predict.
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


class Prover:
    """The standing of a robot's position, and its fixes on trial.

    Args:
        graph: the experience graph; it may grow.
        accepted: limits of agreement, and when fixes settle.

    Attributes:
        standing: of the position, when the frame began.
        told_otherwise: whether a caller-supplied position contradicts the robot's own, and no fix
            has confirmed it yet.
        withdraws: stamps of the fixes that the frame's fix contradicts, ns.
    """

    def __init__(self, graph: ExperienceGraph, accepted: AcceptanceConfig) -> None:
        self._graph = graph
        self._accepted = accepted
        self._record = Record()
        self._chain = FixChain(accepted.sure_confidence, accepted.settle_after_m)
        self.standing = Standing()
        self._told = False
        self.told_otherwise = False
        self.withdraws: tuple[int, ...] = ()

    @property
    def on_trial(self) -> bool:
        """Whether the last fixes may still be withdrawn."""
        return self._chain.on_trial

    @property
    def doubted(self) -> bool:
        """Whether the position may well be wrong: unconfirmed, or expected fixes are missing."""
        after = self._accepted.doubt_after
        return after > 0 and (self._told or self.standing.missed >= after)

    def begin_frame(self, tracked: int) -> None:
        """Begins a frame, with the landmarks that odometry tracked; nothing is withdrawn yet."""
        self._record.begin_frame(tracked)
        self.standing, self.withdraws = self._record.standing, ()

    def carry_on(self, prev_from_curr: SE3, covariance: NDArray[np.float64]) -> None:
        """Carries the fixes on trial on by the robot's motion.

        Args:
            prev_from_curr: pose of this frame in the one before.
            covariance: (6, 6) float64 of that pose, left perturbation, [translation in m,
                rotation in rad].
        """
        self._chain.carry_on(prev_from_curr, covariance)

    def forget(self, agreed: int = 0, *, told_otherwise: bool = False) -> None:
        """The position is another, confirmed by so many fixes; those before it stay."""
        self.told_otherwise = told_otherwise and (self.told_otherwise or not self._told)
        self._told = not agreed
        self._record.forget(agreed)
        self._chain.settle()

    def settled(self) -> None:
        """The live frame was saved as a node, which is the position from now on."""
        self._told = False
        self._record.settled()

    def missed(self) -> None:
        """A frame with predicted candidates had no match."""
        self._record.missed()

    def prove(
        self,
        live: Frame,
        success: Outcome,
        before: Position | None,
        alone_m: float = 0.0,
        *,
        certain: bool,
        usual: int | None = None,
    ) -> None:
        """Checks a fix against earlier ones; of two that contradict, the weaker is withdrawn.

        Args:
            live: the live frame.
            success: the accepted match.
            before: the position before it; None if unknown.
            alone_m: distance driven since the nodes being saved lost their connection to the map,
                metres: a fix that nothing predicts reconnects them.
            certain: whether odometry since the last match had only short gaps.
            usual: inliers that the node has with its neighbour; None if unknown. A robot that
                meets a node where it was saved has more, and need not have them elsewhere.
        """
        evidence, found = success.evidence, success.position
        assert evidence is not None
        predicted = math.isfinite(evidence.apart)
        before = self._chain.position or before
        fits = True if predicted else self._agrees(found, before if certain else None)
        alone = confidence_of(live.descriptor).alone(evidence)
        accepted = self._accepted
        joins_after_m = 0.0 if fits else min(accepted.join_share * alone_m, accepted.join_after_m)
        joins = joins_after_m > accepted.settle_after_m
        if fits is False or joins or not self.standing.agreed:
            withdraws = self._chain.begin(live.stamp_ns, found, alone, joins_after_m)
            self.withdraws = withdraws if fits is False else ()
        else:
            self._chain.join(live.stamp_ns, found, alone)
        self._told = self.told_otherwise = False
        inliers = success.match.inliers
        self._record.fixed(inliers if usual is None else min(inliers, usual), agrees=fits is True)

    def leans(self, live: Frame, success: Outcome, *, certain: bool) -> bool:
        """Whether a fix is weak, and a position that earlier ones had confirmed predicted it.

        Args:
            live: the live frame.
            success: the accepted match.
            certain: whether odometry since the last match had only short gaps.
        """
        assert success.evidence is not None
        weak = success.match.inliers < confidence_of(live.descriptor).weak_inliers
        predicted = certain and math.isfinite(success.evidence.apart)
        return weak and predicted and self.standing.agreed > 0

    def _agrees(self, found: Position, before: Position | None) -> bool | None:
        """Whether a match that nothing predicted agrees with a position; None if unknown."""
        if before is None:
            return None
        there = seen_from(self._graph, found.node, before)
        if there is None:
            return None
        sigma_rad = float(np.sqrt(there.covariance[4, 4]))
        prediction = Prediction(there.node_from_live, there.sigma_m, sigma_rad)
        return agrees(found.node_from_live, prediction, self._accepted)
