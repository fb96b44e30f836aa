"""Attempts made so far in this drive; ranking policies learn from them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from engram.frontend import Frame
from engram.graph.basin import MatchBasin
from engram.graph.model import Attempt, NodeId
from engram.graph.neighbourhood import Neighbourhood
from engram.localiser.attempts import Outcome
from engram.localiser.lenses import Lenses
from engram.ranking import Observations, RecentAttempts, RecentConfig, RunAttempts, RunLog


class Tried:
    """The attempts of the last iterations, and those of the drive with where they were made.

    Args:
        config: how far back the last iterations reach.
        basin: of the live camera.
        lenses: of the map's drives.
    """

    def __init__(self, config: RecentConfig, basin: MatchBasin, lenses: Lenses) -> None:
        self._config = config
        self._basin = basin
        self._lenses = lenses
        self._recent = RecentAttempts(config)
        self._run = RunLog()

    @property
    def config(self) -> RecentConfig:
        """How far back the last iterations reach."""
        return self._config

    @property
    def iteration(self) -> int:
        """Number of the current iteration."""
        return self._recent.iteration

    @property
    def observations(self) -> Observations:
        """The attempts of the last iterations."""
        return self._recent.observations

    def run(self, driven_m: float) -> RunAttempts:
        """The attempts of the drive that are remembered after `driven_m` metres."""
        return self._run.attempts(driven_m)

    def resume(self, next_iteration: int) -> None:
        """Continues with this iteration, without the last ones."""
        self._recent = RecentAttempts(self._config, next_iteration)

    def begin_frame(self, driven_m: float) -> None:
        """Begins a frame at this distance driven, metres."""
        self._recent.begin_frame(driven_m)

    def add(
        self,
        live: Frame,
        driven_m: float,
        near: Neighbourhood | None,
        outcomes: Sequence[Outcome],
    ) -> None:
        """Adds the outcomes of one frame.

        Args:
            live: the frame.
            driven_m: odometry distance from the session's start, metres.
            near: the neighbourhood of its predicted candidates.
            outcomes: of all its attempts.
        """
        # A lost robot's failed proposals tell nothing of the appearance here: they are elsewhere.
        here = [one for one in outcomes if one.candidate.row is not None or one.accepted]
        self._recent.add([one.candidate.index for one in here], [one.accepted for one in here])
        self._run.add(
            driven_m,
            [one.candidate.index for one in outcomes],
            self._expected(near, outcomes),
            [one.accepted for one in outcomes],
            [one.match.inliers for one in outcomes],
            len(live.landmarks),
        )

    def stored(
        self,
        near: Neighbourhood,
        reference: NodeId,
        outcomes: Sequence[Outcome],
        policy: str,
    ) -> list[Attempt]:
        """The attempts of the current iteration that had a prediction, as a map stores them.

        Args:
            near: the neighbourhood of the candidates.
            reference: node that the position referred to.
            outcomes: of all attempts.
            policy: name of the policy that ordered them.
        """
        return [
            Attempt(
                iteration=self.iteration,
                reference=reference,
                node=outcome.candidate.node,
                along_m=float(near.along_m[row]),
                across_m=float(near.across_m[row]),
                yaw_rad=float(near.yaw_rad[row]),
                sigma_m=float(near.sigma_m[row]),
                sigma_yaw_rad=float(near.sigma_yaw_rad[row]),
                accepted=outcome.accepted,
                inliers=outcome.match.inliers,
                rank=outcome.rank,
                policy=policy,
            )
            for outcome in outcomes
            if (row := outcome.candidate.row) is not None
        ]

    def _expected(
        self, near: Neighbourhood | None, outcomes: Sequence[Outcome]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(R,) distances, metres, and rates of success of attempts; NaN without a prediction."""
        distance_m, rates = np.full((2, len(outcomes)), np.nan)
        predicted = [one.candidate.row for one in outcomes]
        known = [at for at, row in enumerate(predicted) if row is not None]
        if near is None or not known:
            return distance_m, rates
        rows = [row for row in predicted if row is not None]
        seen = self._lenses.as_seen(near)
        distance_m[known] = np.hypot(seen.distance_m[rows], seen.sigma_m[rows])
        rates[known] = self._basin.success_rate(seen.along_m[rows], seen.across_m[rows])
        for at, row in zip(known, rows, strict=True):
            found = outcomes[at].match.reference_from_live
            if outcomes[at].accepted and found is not None:
                from_node_m = found.translation
                if seen is not near:
                    shift_m = self._lenses.shifts_m(near.nodes[[row]])
                    from_node_m = from_node_m - np.array([0.0, 0.0, *shift_m])
                distance_m[at] = math.sqrt(from_node_m @ from_node_m)
        return distance_m, rates
