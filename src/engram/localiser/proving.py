"""Checks each fix against earlier ones: how far the position is confirmed, what to withdraw."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from engram.frontend import Frame
from engram.geometry import SE3
from engram.graph.graph import ExperienceGraph
from engram.localiser.acceptance import AcceptanceConfig, Prediction, agrees
from engram.localiser.attempts import Outcome
from engram.localiser.chain import FixChain
from engram.localiser.confidence import Record, Standing, confidence_of
from engram.localiser.fusing import seen_from
from engram.localiser.localisation import Position


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
