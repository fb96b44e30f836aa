"""Γ(recall), Engram's own: ranks by the inliers expected from this run and past drives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram import _core
from engram.config import check_bounds
from engram.graph.basin import prior_basin_m
from engram.graph.model import NodeId
from engram.places.words import NodeWords
from engram.ranking.context import RankingContext, Reasons, order_by


def likenesses(
    words: NodeWords, live: NDArray[np.int32], nodes: Sequence[NodeId]
) -> NDArray[np.float64]:
    """(Y,) float64: cosine, 0…1, of the idf-weighted word sets of a frame and each node.

    Args:
        live: (n,) int32, the distinct words of the frame.
        nodes: Y nodes; damaged ones count as without words.
    """
    weights = words.idf**2
    seen = np.zeros(len(weights))
    seen[live] = weights[live]
    nothing = np.zeros(0, np.int32)
    found = [words.of_node(node) for node in nodes]
    sets = [nothing if one is None else one for one in found]
    met = np.concatenate([*sets, nothing])
    place = np.repeat(np.arange(len(sets)), [len(one) for one in sets])
    shared, whole = (
        np.bincount(place, values[met], minlength=len(sets)) for values in (seen, weights)
    )
    norms = float(np.sqrt(seen.sum())) * np.sqrt(whole)
    return np.divide(shared, norms, out=np.zeros(len(sets)), where=norms > 0)


def standard_likenesses(context: RankingContext) -> NDArray[np.float64]:
    """(Y,) float64: similarity of each candidate to the frame, in standard deviations over all.

    Zeros without a vocabulary, and if all are equally similar.
    """
    words, nodes = context.background.words, context.neighbourhood.nodes
    if words is None or context.live_words is None or len(nodes) == 0:
        return np.zeros(len(nodes))
    ids = [context.graph.node(node).id for node in nodes.tolist()]
    alike = likenesses(words, context.live_words(), ids)
    alike -= alike.mean()
    deviation = alike.std()
    return alike / deviation if deviation > 1e-9 else np.zeros(len(nodes))


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RecallConstants:
    """The constants of Γ(recall); `RECALL` ships with the package.

    A margin is the logarithm of inliers over those that a match needs. Source: fitted on
    `village@2`, a town used for no evaluation, by `engram_lab.fits.recall`, and rounded; results
    depend little on any but `distance`.

    Raises:
        ConfigError: a value is out of its bounds.
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
            description="margin per log odds of a match with the node by past drives",
        ),
    ] = 0.3
    level: Annotated[
        float,
        Meta(
            description="margin at zero distance of a node that every second past drive matched",
        ),
    ] = 0.5
    prior_weight: Annotated[
        float,
        Meta(
            gt=0,
            description="weight of all past drives together, in attempts made now",
        ),
    ] = 0.5
    memory_m: Annotated[
        float,
        Meta(
            gt=0,
            description="distance driven over which the weight of an attempt falls e-fold, m",
        ),
    ] = 4.0
    regret: Annotated[
        float,
        Meta(
            ge=0,
            description="weight of the assumed failure of each earlier pick, in attempts made now",
        ),
    ] = 2.0
    tally: Annotated[
        float,
        Meta(
            ge=0,
            description="margin per log of this run's success rate with the node's drive, relative "
            "to that of an untried drive",
        ),
    ] = 0.5
    tally_memory_m: Annotated[
        float,
        Meta(
            gt=0,
            description="distance over which the weight of an attempt in that rate falls e-fold, m",
        ),
    ] = 8.0
    untried_rate: Annotated[
        float,
        Meta(gt=0, description="success rate of an untried drive. Source: method §4, as Γ(bandit)"),
    ] = 0.3
    untried_attempts: Annotated[
        float,
        Meta(gt=0, description="weight of that rate, in attempts. Source: method §4, as Γ(bandit)"),
    ] = 1.0
    likeness: Annotated[
        float,
        Meta(
            ge=0,
            description="margin per standard deviation of visual similarity to the frame. "
            "Source: trials with lost robots",
        ),
    ] = 0.4
    vague_m: Annotated[
        float,
        Meta(
            ge=0,
            description="standard deviation of the most certain candidate from which similarity "
            "counts, m. Source: trials with lost robots",
        ),
    ] = 0.5
    steepness: Annotated[float, Meta(gt=0, description="log odds of a success per margin")] = 1.8
    bias: Annotated[float, Meta(description="log odds of a success at margin 0")] = 0.6
    needed: Annotated[
        int,
        Meta(
            ge=1,
            description="fewest inliers of a match; an attempt without any counts as one. "
            "Source: method §3",
        ),
    ] = 20
    attempts: Annotated[
        int,
        Meta(
            ge=0,
            description="most recent attempts of this run that count: 20 m at four every 0.7 m",
        ),
    ] = 128
    picks: Annotated[int, Meta(ge=0, description="number of greedy picks")] = 8
    shortlist: Annotated[int, Meta(ge=0, description="best candidates to pick from")] = 32

    def __post_init__(self) -> None:
        check_bounds(self)


RECALL = RecallConstants()

_MEANING = {
    "distance": "log inliers lost to distance; position uncertainty adds distance. Before any pick "
    "all terms add up to the log of the expected inliers over the 20 needed",
    "likeness": "visual similarity compared with the other candidates; only if the position is "
    "uncertain",
    "past drives": "how past drives fared with the node; counts less the more this run has tried",
    "this run": "how this run fared with the node and its drive in the last metres",
    "tally": "how often this run matched the node's drive: one that keeps failing falls behind, "
    "however narrowly it fails",
}


@dataclass(frozen=True, slots=True, eq=False)
class RecallJudgement:
    """The ranking of one frame's candidates by Γ(recall).

    Attributes:
        order: (Y,) int64, rows best first.
        chances: (Y,) float64, probability of success when picked, if all earlier picks failed.
        terms: name → (Y,) float64, the parts of the initial margin, log ratios; they add up.
        by_turn: (Y,) bool by row, whether its place is by rotation.
    """

    order: NDArray[np.int64]
    chances: Array
    terms: dict[str, Array]
    by_turn: NDArray[np.bool_]


class RecallPolicy:
    """By the expected inliers of a match, picked greedily and diversely.

    Inliers fall exponentially with distance. Corrected for that, they measure how similar the
    node's drive looks now. The evidence is this run's attempts, weighted by recency; past drives
    if there are none; and words if the distance is unknown. Success rates count too, as inliers
    alone would retry a drive that narrowly fails for ever. Each pick assumes that the earlier ones
    failed, so that nodes likely to fail with them come later.

    Args:
        constants: None for those of the package.
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
            "greatest sum first; each pick assumes that the earlier ones failed, which lowers the "
            "others of their drives",
        )

    def _in_turns(
        self, context: RankingContext, order: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Gives every second place by rotation if the predictions are too uncertain for a match.

        Otherwise a lost robot would try the same few nodes for ever. These places go to the nodes
        tried least often of late; in every second frame they come first, for a robot with one
        attempt per frame. Returns the order, and (Y,) bool by row: whether its place is by
        rotation.
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
        """(Y,) float64 each, nearest first: cost, prior by past drives, gain by similarity.

        The cost is the margin lost by distance less that gain.
        """
        c, near = self._constants, context.neighbourhood
        past = context.background.lessons.log_odds_of(near.nodes[canonical])
        likeness = self._likeness(context, canonical)
        costs = self._per_m(context) * context.as_seen.rms_distance_m[canonical] - likeness
        return costs, c.level + c.lessons * past, likeness

    def _likeness(self, context: RankingContext, canonical: NDArray[np.int64]) -> Array:
        """(Y,) float64, nearest first: margins gained by similarity to the live frame.

        Shared words are noise compared with distance and this run, unless the distance is unknown.
        """
        c, sigma_m = self._constants, context.neighbourhood.sigma_m
        if len(canonical) == 0 or sigma_m.min() < c.vague_m:
            return np.zeros(len(canonical))
        return np.asarray(c.likeness * standard_likenesses(context)[canonical])

    def _per_m(self, context: RankingContext) -> float:
        """Margin lost per metre; a longer focal length matches from farther away."""
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
            _core.RecallCandidates(nodes, graph.sessions_of(nodes), costs, prior),
            self._bound,
        )


def _bound(constants: RecallConstants) -> _core.RecallConstants:
    """The constants for the core, without `per_m`, which depends on the focal length."""
    bound = _core.RecallConstants()
    for field in fields(constants):
        if hasattr(bound, field.name):  # the core uses neither similarity nor probabilities
            setattr(bound, field.name, getattr(constants, field.name))
    return bound
