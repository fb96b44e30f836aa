"""Attempts at places where a robot is not: every node of a map that is far from it, or elsewhere.

Few robots that are misplaced by chance meet a place that looks alike. Here each frame of a drive is
matched with each node at least `OFF_M` away, as by a lost robot. Where landmarks agree on a pose
all the same, robots are told to be there, or carried to the frame from there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3
from engram.graph.model import node_id
from engram.localiser.acceptance import Prediction
from engram.localiser.attempts import Attempter, Candidate, Outcome
from engram.localiser.confidence import UNKNOWN, Standing
from engram_lab.misplaced import OFF_M, SIGMA_RAD, SIGMAS_M, Street

# Matches of fewer inliers can be no fix by any rule.
LEAST_INLIERS = 12
# Fixes that should have come since the robot is misplaced, at most; until it doubts by itself. And
# fixes of one that was carried before.
_MOST_MISSED = 3.0
_CONFIRMED = 20


@dataclass(frozen=True, slots=True, eq=False)
class WrongPlace:
    """An attempt at a node where the robot is not.

    Attributes:
        frame: number of the live frame.
        outcome: what came of it.
    """

    frame: int
    outcome: Outcome


class WrongPlaces:
    """All attempts of a drive at the nodes of a map that are elsewhere.

    Args:
        street: the map and the drive.
        every: frames from one that is tried to the next.

    Attributes:
        attempts: how many attempts were made so far.
    """

    def __init__(self, street: Street, every: int = 1) -> None:
        self._street, self._every = street, every
        opened, config = street.opened, street.settings.localiser
        self._config = config
        self._attempter = Attempter(opened.frames, config)
        self._nodes = opened.graph.nodes
        self.attempts = 0

    def lost(self) -> Iterator[WrongPlace]:
        """As by a lost robot, without a prediction; those of `LEAST_INLIERS` and a pose."""
        for frame in range(0, len(self._street.frames), self._every):
            for index in self._elsewhere(frame):
                self.attempts += 1
                outcome = self._attempt(frame, index, None, UNKNOWN)
                if self._is_wrong(frame, outcome):
                    yield WrongPlace(frame, outcome)

    def believed(self, there: WrongPlace, usual_inliers: float = 0.0) -> Iterator[WrongPlace]:
        """As by robots whose position is where such a match is, with each deviation.

        Args:
            there: the match.
            usual_inliers: of the fixes of a robot that was carried; 0 for one that was told so.
        """
        pose, index = there.outcome.match.reference_from_live, there.outcome.candidate.index
        assert pose is not None
        rng = np.random.default_rng([there.frame, index])
        for sigma_m in SIGMAS_M:
            off = np.concatenate([rng.normal(0.0, sigma_m, 3), rng.normal(0.0, SIGMA_RAD, 3)])
            prediction = Prediction(pose @ SE3.exp(off), sigma_m, SIGMA_RAD)
            missed = float(rng.uniform(0.0, _MOST_MISSED))
            standing = Standing(missed=missed)
            if usual_inliers:
                tracked = float(self._tracked[there.frame])
                standing = Standing(_CONFIRMED, missed, usual_inliers, tracked)
            self.attempts += 1
            outcome = self._attempt(there.frame, index, prediction, standing)
            if self._is_wrong(there.frame, outcome):
                yield WrongPlace(there.frame, outcome)

    @cached_property
    def _tracked(self) -> NDArray[np.float64]:
        """Share of the usual landmarks that odometry tracks to each frame; see `Standing`."""
        counts = np.array([one.odometry.inliers for one in self._street.frames], np.float64)
        known = counts > 0
        usual = float(np.median(counts[known])) if known.any() else 1.0
        return np.where(known, np.minimum(counts / usual, 1.0), 1.0)

    def _attempt(
        self, frame: int, index: int, prediction: Prediction | None, standing: Standing
    ) -> Outcome:
        live = self._street.frames[frame].frame
        guided = (
            prediction is not None
            and prediction.sigma_m < self._config.guide_below_m
            and prediction.sigma_yaw_rad < self._config.guide_below_rad
        )
        candidate = Candidate(
            index, self._nodes[index].id, prediction, guided, None, standing.agreed == 0, standing
        )
        seen = node_id(self._street.live.session.id, live.stamp_ns)
        return self._attempter.attempt(live, seen, 0, candidate)

    def _is_wrong(self, frame: int, outcome: Outcome) -> bool:
        """Whether enough landmarks agree on a pose, and it is false."""
        match = outcome.match
        if match.reference_from_live is None or match.inliers < LEAST_INLIERS:
            return False
        return bool(self._street.is_false(frame, outcome.candidate.node, match.reference_from_live))

    def _elsewhere(self, frame: int) -> NDArray[np.int64]:
        """Nodes by index whose truth is known and far from the frame's."""
        if not self._street.same_town:
            return np.arange(len(self._nodes))
        apart_m = np.linalg.norm(self._at_m - self._street.truth[frame].translation, axis=1)
        return np.flatnonzero(apart_m >= OFF_M)

    @cached_property
    def _at_m(self) -> NDArray[np.float64]:
        poses = [self._street.nodes.pose(node.id) for node in self._nodes]
        return np.array([np.full(3, np.nan) if p is None else p.translation for p in poses])
