"""Match attempts: lanes at once, rounds one after another (SPEC §3.2)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Protocol, Self

import numpy as np

from engram.errors import MapCorruptError
from engram.frontend import Frame
from engram.frontend.matching import NO_MATCH, Match, MatcherConfig, match_frames, pair_seed
from engram.graph.model import LandmarkSource, NodeId
from engram.localiser.acceptance import (
    AcceptanceConfig,
    Prediction,
    Spread,
    accept,
    accept_lost,
    inlier_spread,
    plausible,
)


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A node to be attempted.

    Attributes:
        index: its dense index in the experience graph.
        node: its UUID.
        prediction: where the live camera is expected; None when relocalising.
        guided: whether matching uses the prediction (a named step of its own, SPEC §3.2).
        row: its row in the neighbourhood; None when relocalising.
        doubted: whether the prediction may be wrong: the robot is lost, and knows its place by no
            nodes of its own.
    """

    index: int
    node: NodeId
    prediction: Prediction | None
    guided: bool
    row: int | None
    doubted: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What became of one attempt.

    Attributes:
        candidate: what was attempted.
        rank: its place in the order, from 0.
        match: with what it has in common with the live frame.
        accepted: whether that is a localisation.
        plausible: whether it would be one if another frame agreed; only of lost robots.
        damaged: whether the node's landmarks could not be read, so that there is nothing to match.
    """

    candidate: Candidate
    rank: int
    match: Match
    accepted: bool
    plausible: bool = False
    damaged: bool = False


class Matcher(Protocol):
    """The first half of an attempt, a pure function of two frames (SPEC §3.2)."""

    @property
    def threads(self) -> bool:
        """Whether attempts gain by running on threads of their own."""
        ...

    def match(self, live: Frame, live_id: NodeId, node: NodeId, guide: Prediction | None) -> Match:
        """The match of a live frame with a node; `guide` is given for a guided attempt only."""
        ...

    def spread(self, live: Frame, live_id: NodeId, node: NodeId, match: Match) -> Spread:
        """`inlier_spread` of such a match."""
        ...

    def prefetch(self, nodes: list[NodeId]) -> None:
        """Hint that these are likely to be matched next. Returns at once."""
        ...


class FrameMatcher:
    """Matches with the landmarks that a source holds: what runs on a robot.

    Args:
        frames: the landmarks.
        config: settings.
        threads: whether attempts run on threads of their own. Not where processes share the
            cores anyway: every hand-over waits for its turn there.
    """

    def __init__(
        self, frames: LandmarkSource, config: MatcherConfig, *, threads: bool = True
    ) -> None:
        self._frames = frames
        self._config = config
        self._threads = threads

    @property
    def threads(self) -> bool:
        """See `Matcher`."""
        return self._threads

    def match(self, live: Frame, live_id: NodeId, node: NodeId, guide: Prediction | None) -> Match:
        """See `Matcher`; seeded by both UUIDs."""
        covariance = None
        if guide is not None:
            covariance = np.diag([guide.sigma_m**2] * 3 + [guide.sigma_yaw_rad**2] * 3)
        return match_frames(
            self._frames.frame(node),
            live,
            self._config,
            seed=pair_seed(live_id, node),
            predicted=None if guide is None else guide.node_from_live,
            predicted_covariance=covariance,
        )

    def spread(self, live: Frame, live_id: NodeId, node: NodeId, match: Match) -> Spread:
        """See `Matcher`."""
        del live_id
        return inlier_spread(match, self._frames.frame(node), live)

    def prefetch(self, nodes: list[NodeId]) -> None:
        """See `Matcher`."""
        self._frames.prefetch(nodes)


class Attempter:
    """Runs attempts on threads of its own; the core releases the GIL, so they are parallel.

    Args:
        matcher: the first half of an attempt.
        lost_matcher: the same where nothing is expected, and most candidates are other places.
        lanes: how many run at a time.
        acceptance: the second half.
    """

    def __init__(
        self, matcher: Matcher, lost_matcher: Matcher, lanes: int, acceptance: AcceptanceConfig
    ) -> None:
        self._matcher = matcher
        self._lost_matcher = lost_matcher
        self._lanes = lanes
        self._acceptance = acceptance
        self._pool = (
            ThreadPoolExecutor(lanes, thread_name_prefix="engram-lane")
            if lanes > 1 and matcher.threads
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

    def prefetch(self, nodes: list[NodeId]) -> None:
        """Hint that these are likely to be attempted next."""
        self._matcher.prefetch(nodes)

    def run(
        self,
        live: Frame,
        live_id: NodeId,
        candidates: Sequence[Candidate],
        deadline: float | None,
    ) -> list[Outcome]:
        """Attempts in ranked order; stops after the first round with a success.

        A node whose landmarks are damaged is passed over, and its outcome says so: a robot can do
        without one node of its map.

        Args:
            live: the live frame.
            live_id: its UUID, which with the node's seeds the matcher.
            candidates: best first, as many as the budget allows.
            deadline: `time.perf_counter` value after which no attempt starts; None for none.

        Returns:
            One outcome per attempt made, in ranked order.
        """
        outcomes: list[Outcome] = []
        for start in range(0, len(candidates), self._lanes):
            if deadline is not None and perf_counter() >= deadline:
                break
            ranks = range(start, min(start + self._lanes, len(candidates)))
            outcomes += self._round(live, live_id, candidates, ranks)
            if any(outcome.accepted for outcome in outcomes):
                break
        return outcomes

    def _round(
        self, live: Frame, live_id: NodeId, candidates: Sequence[Candidate], ranks: range
    ) -> list[Outcome]:
        def attempt(rank: int) -> Outcome:
            return self._attempt(live, live_id, candidates[rank], rank)

        if self._pool is None or len(ranks) == 1:
            return [attempt(rank) for rank in ranks]
        return list(self._pool.map(attempt, ranks))

    def _attempt(self, live: Frame, live_id: NodeId, candidate: Candidate, rank: int) -> Outcome:
        try:
            return self._attempt_undamaged(live, live_id, candidate, rank)
        except MapCorruptError:
            return Outcome(candidate, rank, NO_MATCH, accepted=False, damaged=True)

    def _attempt_undamaged(
        self, live: Frame, live_id: NodeId, candidate: Candidate, rank: int
    ) -> Outcome:
        prediction = candidate.prediction
        if prediction is None:
            return self._attempt_lost(live, live_id, candidate, rank)
        guide = prediction if candidate.guided else None
        match = self._matcher.match(live, live_id, candidate.node, guide)
        if accept(match, prediction, self._acceptance):
            return Outcome(candidate, rank, match, accepted=True)
        if not candidate.doubted:
            return Outcome(candidate, rank, match, accepted=False)
        spread = partial(self._matcher.spread, live, live_id, candidate.node, match)
        waits = plausible(match, spread, self._acceptance)
        return Outcome(candidate, rank, match, accepted=False, plausible=waits)

    def _attempt_lost(
        self, live: Frame, live_id: NodeId, candidate: Candidate, rank: int
    ) -> Outcome:
        match = self._lost_matcher.match(live, live_id, candidate.node, None)
        spread = partial(self._lost_matcher.spread, live, live_id, candidate.node, match)
        return Outcome(
            candidate,
            rank,
            match,
            accept_lost(match, spread, self._acceptance),
            plausible(match, spread, self._acceptance),
        )

    def foresee(
        self, live: Frame, live_id: NodeId, candidates: Iterable[Candidate]
    ) -> list[Outcome]:
        """What would become of these attempts; for the policy that knows it all (SPEC §4)."""
        return [
            self._attempt(live, live_id, candidate, rank)
            for rank, candidate in enumerate(candidates)
        ]


def best_success(outcomes: Sequence[Outcome]) -> Outcome | None:
    """The success with the most inliers; among equals the one that ranked higher (SPEC §3.2)."""
    successes = [outcome for outcome in outcomes if outcome.accepted]
    return min(successes, key=lambda o: (-o.match.inliers, o.rank), default=None)
