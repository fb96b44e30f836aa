"""Γ(recall), Engram's own: how many inliers a match would have, by this run and past drives."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram import _core
from engram.config import check_bounds
from engram.graph.basin import prior_basin_m
from engram.ranking.context import RankingContext, order_by
from engram.ranking.likeness import standard_likenesses
from engram.ranking.reasons import Reasons

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RecallConstants:
    """The constants of Γ(recall); `RECALL` ships with the package.

    Margins are logarithms of inliers over those that a match needs. Source: found on `village@2`, a
    town that nothing is judged on, by `engram_lab.fits.recall`, and rounded: what is lost depends
    little on any of them but the distance.

    Raises:
        ConfigError: one is out of its bounds.
    """

    distance: Annotated[
        float,
        Meta(
            ge=0,
            description="margin lost per shipped match basin between node and robot, root mean "
            "square",
        ),
    ] = 1.1
    lessons: Annotated[
        float,
        Meta(
            ge=0,
            description="margin per log odds of how likely past drives matched the node",
        ),
    ] = 0.3
    level: Annotated[
        float,
        Meta(
            description="margin at no distance of a node that every other past drive matched",
        ),
    ] = 0.5
    prior_weight: Annotated[
        float,
        Meta(
            gt=0,
            description="how many attempts of this very moment all past drives together are worth",
        ),
    ] = 0.5
    memory_m: Annotated[
        float,
        Meta(
            gt=0,
            description="metres driven over which an attempt of this run comes to weigh e times "
            "less",
        ),
    ] = 4.0
    regret: Annotated[
        float,
        Meta(
            ge=0,
            description="how many attempts of this very moment a pick counts as, supposed to have "
            "failed",
        ),
    ] = 2.0
    tally: Annotated[
        float,
        Meta(
            ge=0,
            description="margin per log of how often this run matched the node's drive, over that "
            "of a drive not tried yet",
        ),
    ] = 0.5
    tally_memory_m: Annotated[
        float,
        Meta(
            gt=0,
            description="metres driven over which an attempt weighs e times less there",
        ),
    ] = 8.0
    untried_rate: Annotated[
        float,
        Meta(
            gt=0, description="success rate of a drive not tried yet. Source: SPEC §4, as Γ(bandit)"
        ),
    ] = 0.3
    untried_attempts: Annotated[
        float,
        Meta(
            gt=0, description="how many attempts that rate is worth. Source: SPEC §4, as Γ(bandit)"
        ),
    ] = 1.0
    likeness: Annotated[
        float,
        Meta(
            ge=0,
            description="margin per standard deviation that a node looks more like the frame than "
            "the others do. Source: trials with lost robots",
        ),
    ] = 0.4
    vague_m: Annotated[
        float,
        Meta(
            ge=0,
            description="how vaguely even the surest candidate is known, σ in m, before likeness "
            "counts. Source: trials with lost robots",
        ),
    ] = 0.5
    steepness: Annotated[float, Meta(gt=0, description="log odds of a success per margin")] = 1.8
    bias: Annotated[float, Meta(description="log odds of a success at margin 0")] = 0.6
    needed: Annotated[
        int,
        Meta(
            ge=1,
            description="fewest inliers of a match; an attempt without any counts as one. "
            "Source: SPEC §3",
        ),
    ] = 20
    attempts: Annotated[
        int,
        Meta(
            ge=0,
            description="how many of this run's newest attempts count: 20 m at four every 0.7 m",
        ),
    ] = 128
    picks: Annotated[int, Meta(ge=0, description="how many picks are made greedily")] = 8
    shortlist: Annotated[int, Meta(ge=0, description="among how many of the best they are")] = 32

    def __post_init__(self) -> None:
        check_bounds(self)


RECALL = RecallConstants()

_MEANING = {
    "distance": "log of inliers lost by the distance of the node, which is the longer the more "
    "vaguely it is known; all terms add up, before any "
    "pick, to the log of inliers expected over the 20 needed",
    "likeness": "how much liker than the others it looks, by its words; only where the robot does "
    "not know well where it is",
    "past drives": "how past drives fared with the node, as far as this run has not spoken",
    "this run": "how this run fared with the node's drive and the node, over the last metres",
    "tally": "how often this run matched the node's drive: what keeps failing gives way, however "
    "nearly it matches",
}


@dataclass(frozen=True, slots=True, eq=False)
class RecallJudgement:
    """What Γ(recall) thinks of the candidates of one frame.

    Attributes:
        order: (Y,) int64, rows best first.
        chances: (Y,) of success when picked, all picked before supposed to have failed.
        terms: name → (Y,), the parts of the margin at first; they add up.
        by_turn: (Y,) bool by row, whether it stands where it does because its turn has come.
    """

    order: NDArray[np.int64]
    chances: Array
    terms: dict[str, Array]
    by_turn: NDArray[np.bool_]


class RecallPolicy:
    """By the inliers that a match would have, picked greedily and diversely.

    Inliers fall exponentially with distance. What is left when that is made up for tells how
    alike the node's drive looks now: this run's attempts say so, the newest loudest, past drives
    where it has not tried, and words where nobody knows the distance. Inliers alone would let a
    drive that just fails be tried for ever; so its successes and failures count, too. Each pick is
    made as if those before it had failed: what would fail with them comes later.

    Args:
        constants: None for those that ship with the package.
    """

    name = "recall"
    uses_words = True

    def __init__(self, constants: RecallConstants = RECALL) -> None:
        self._constants = constants
        self._bound = _bound(constants)

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        canonical = order_by(context)
        costs, prior, _ = self._costs_and_prior(context, canonical)
        order: NDArray[np.int64] = canonical[self._pick(context, canonical, costs, prior)[0]]
        return self._in_turns(context, order)[0]

    def judge(self, context: RankingContext) -> RecallJudgement:
        """The ranking with its reasons."""
        c, canonical = self._constants, order_by(context)
        costs, prior, likeness = self._costs_and_prior(context, canonical)
        order, margins, first, tally = self._pick(context, canonical, costs, prior)
        rows = np.empty_like(canonical)
        rows[canonical] = np.arange(len(canonical))
        terms = {
            "distance": -costs - likeness,
            "likeness": likeness,
            "past drives": prior,
            "this run": first + costs - prior - tally,
            "tally": tally,
        }
        picks, by_turn = self._in_turns(context, canonical[order])
        return RecallJudgement(
            picks,
            1 / (1 + np.exp(-c.bias - c.steepness * margins[rows])),
            {name: values[rows] for name, values in terms.items()},
            by_turn,
        )

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        judged = self.judge(context)
        return Reasons(
            judged.terms,
            _MEANING,
            judged.chances,
            judged.by_turn,
            "greatest sum first; each pick supposes that those before it failed, which takes from "
            "the others of their drives",
        )

    def _in_turns(
        self, context: RankingContext, order: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Every second pick goes by turns where nobody knows how far the nodes are.

        A robot that has lost its place would try the same few nodes for ever, those where it
        believes to be. Where they are expected more vaguely than a match bears, every second one is
        of those that were tried least often of late, in every second frame the first: a robot that
        has one attempt a frame must not stay with the best. Tells by row, too, whose place is by
        turn.
        """
        near = context.neighbourhood
        vague = near.sigma_m[order] > prior_basin_m(context.basin.focal_px)
        by_turn = np.zeros(len(order), dtype=np.bool_)
        if not vague.any():
            return order, by_turn
        run = context.run.newest(self._constants.attempts)
        tried = (run.nodes[:, None] == near.nodes[order]).sum(axis=0)
        turns = order[np.argsort(np.where(vague, tried, 0), kind="stable")]
        turn_first = run.frames % 2
        pair = [turns, order] if turn_first else [order, turns]
        mixed = np.stack(pair, axis=1).ravel()
        _, first = np.unique(mixed, return_index=True)
        first.sort()
        picks: NDArray[np.int64] = mixed[first]
        by_turn[picks] = first % 2 != turn_first
        return picks, by_turn

    def _costs_and_prior(
        self, context: RankingContext, canonical: NDArray[np.int64]
    ) -> tuple[Array, Array, Array]:
        """Margins lost by distance less what looks win, by past drives, by looks; (Y,) each.

        All nearest first.
        """
        c, near = self._constants, context.neighbourhood
        base = context.background.lessons.of(near.nodes[canonical])
        likeness = self._likeness(context, canonical)
        costs = self._per_m(context) * near.rms_distance_m[canonical] - likeness
        return costs, c.level + c.lessons * np.log(base / (1 - base)), likeness

    def _likeness(self, context: RankingContext, canonical: NDArray[np.int64]) -> Array:
        """Margins won by looking like the live frame, (Y,), nearest first.

        Which words a frame shares with others of its place is noise beside what distance and this
        run tell, unless nobody knows the distance.
        """
        c, sigma_m = self._constants, context.neighbourhood.sigma_m
        if len(canonical) == 0 or sigma_m.min() < c.vague_m:
            return np.zeros(len(canonical))
        return np.asarray(c.likeness * standard_likenesses(context)[canonical])

    def _per_m(self, context: RankingContext) -> float:
        """A longer lens sees alike from farther away."""
        return self._constants.distance / prior_basin_m(context.basin.focal_px)

    def _pick(
        self, context: RankingContext, canonical: NDArray[np.int64], costs: Array, prior: Array
    ) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """Rows of `canonical` best first; margins as picked and at first, and the tally's part."""
        graph, run, nodes = context.graph, context.run, context.neighbourhood.nodes[canonical]
        self._bound.per_m = self._per_m(context)
        return _core.recall_order(
            _core.RecallRun(
                run.driven_m,
                run.at_m,
                run.nodes,
                graph.sessions_of(run.nodes),
                run.distance_m,
                run.rates,
                run.accepted,
                run.inliers,
            ),
            _core.RecallCandidates(
                nodes, graph.sessions_of(nodes), costs, prior, graph.session_count
            ),
            self._bound,
        )


def _bound(constants: RecallConstants) -> _core.RecallConstants:
    """As the core takes them, but for `per_m`, which the lens decides."""
    bound = _core.RecallConstants()
    for one in fields(constants):
        if hasattr(bound, one.name):  # the core knows no likeness and no chances
            setattr(bound, one.name, getattr(constants, one.name))
    return bound
