"""Match attempts within a budget: lanes at once, rounds one after another (SPEC §3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from time import perf_counter
from typing import Self
from uuid import UUID

import numpy as np

from engram.experience.model import LandmarkSource, NodeId
from engram.frontend import Frame
from engram.frontend.matching import Match, MatcherConfig, match_frames, pair_seed
from engram.localiser.acceptance import AcceptanceConfig, Prediction, accept, inlier_spread
from engram.localiser.localisation import Budget


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A node to be attempted.

    Attributes:
        index: its dense index in the experience graph.
        node: its UUID.
        prediction: where the live camera is expected; None when relocalising.
        guided: whether matching uses the prediction (a named step of its own, SPEC §3.2).
        row: its row in the neighbourhood; None when relocalising.
    """

    index: int
    node: NodeId
    prediction: Prediction | None
    guided: bool
    row: int | None


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What became of one attempt."""

    candidate: Candidate
    rank: int
    match: Match
    accepted: bool


class Attempter:
    """Runs attempts on threads of its own; the core releases the GIL, so they are parallel."""

    def __init__(
        self,
        frames: LandmarkSource,
        budget: Budget,
        matcher: MatcherConfig,
        acceptance: AcceptanceConfig,
    ) -> None:
        self._frames = frames
        self._budget = budget
        self._matcher = matcher
        self._acceptance = acceptance
        self._pool = (
            ThreadPoolExecutor(budget.lanes, thread_name_prefix="engram-lane")
            if budget.lanes > 1
            else None
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def run(
        self,
        live: Frame,
        live_id: UUID,
        candidates: Sequence[Candidate],
        deadline: float | None,
    ) -> list[Outcome]:
        """Attempts in ranked order; stops after the first round with a success.

        Args:
            live: the live frame.
            live_id: its UUID, which with the node's seeds the matcher.
            candidates: best first.
            deadline: `time.perf_counter` value after which no attempt starts; None for none.

        Returns:
            One outcome per attempt made, in ranked order.
        """
        lanes = self._budget.lanes
        outcomes: list[Outcome] = []
        for start in range(0, min(len(candidates), self._budget.attempts), lanes):
            if deadline is not None and perf_counter() >= deadline:
                break
            ranks = range(start, min(start + lanes, len(candidates), self._budget.attempts))
            outcomes += self._round(live, live_id, candidates, ranks)
            if any(outcome.accepted for outcome in outcomes):
                break
        return outcomes

    def _round(
        self, live: Frame, live_id: UUID, candidates: Sequence[Candidate], ranks: range
    ) -> list[Outcome]:
        def attempt(rank: int) -> Outcome:
            return self._attempt(live, live_id, candidates[rank], rank)

        if self._pool is None or len(ranks) == 1:
            return [attempt(rank) for rank in ranks]
        return list(self._pool.map(attempt, ranks))

    def _attempt(self, live: Frame, live_id: UUID, candidate: Candidate, rank: int) -> Outcome:
        prediction = candidate.prediction
        covariance = None
        if candidate.guided and prediction is not None:
            covariance = np.diag([prediction.sigma_m**2] * 3 + [prediction.sigma_yaw_rad**2] * 3)
        node = self._frames.frame(candidate.node)
        match = match_frames(
            node,
            live,
            self._matcher,
            seed=pair_seed(live_id, candidate.node),
            predicted=prediction.node_from_live
            if candidate.guided and prediction is not None
            else None,
            predicted_covariance=covariance,
        )
        spread = inlier_spread(match, node, live) if prediction is None else 1.0
        accepted = accept(match, prediction, self._acceptance, spread)
        return Outcome(candidate, rank, match, accepted)


def best_success(outcomes: Sequence[Outcome]) -> Outcome | None:
    """The success with the most inliers; among equals the one that ranked higher (SPEC §3.2)."""
    successes = [outcome for outcome in outcomes if outcome.accepted]
    return min(successes, key=lambda o: (-o.match.inliers, o.rank), default=None)
