"""Γ(recall), Engram's own: learns from successes and failures, past and present (SPEC §4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.ranking.context import RankingContext, order_by
from engram.ranking.lessons import UNKNOWN_BASE
from engram.ranking.reasons import Reasons
from engram.ranking.times import hour_difference

Array = NDArray[np.float64]
_Judged: TypeAlias = tuple[NDArray[np.int64], Array, Array, Array, Array, Array]


@dataclass(frozen=True, slots=True)
class RecallConstants:
    """The constants of Γ(recall); `RECALL` and `RECALL_NO_CLOCK` ship with the package.

    Attributes:
        bias: log odds where nothing speaks for or against.
        offset: factor of log g(d).
        company: factor of the log odds of how like-minded past drives fared with the node.
        own: factor of log((a + ½) / (b + ½)), this run's tally on the node's session.
        node: factor of the same for the very node.
        hour: per hour of difference in time of day.
        own_m, node_m: memory of the tallies, metres.
        viewers_m: memory in which past drives are weighed, metres.
        trust: what the evidence of one attempt counts for in weighing them.
        viewer_hour: log weight of a past drive per hour of difference.
        regret: how much a pick counts as failed for those after it.
    """

    bias: float
    offset: float
    company: float
    own: float
    node: float
    hour: float
    own_m: float
    node_m: float
    viewers_m: float
    trust: float
    viewer_hour: float
    regret: float


# Not fitted yet: set by hand on a made-up world of appearances (hours, weathers and random likings
# of sessions for each other, without images). Memories are as long as lets a single lane leave an
# experience that has stopped matching within 8 m, against all that past drives say.
# `benchmarks/fit_recall.py` fits them on rendered towns.
RECALL = RecallConstants(
    bias=0.1,
    offset=1.3,
    company=0.6,
    own=0.8,
    node=0.2,
    hour=-0.1,
    own_m=5.0,
    node_m=3.0,
    viewers_m=15.0,
    trust=0.25,
    viewer_hour=-0.1,
    regret=1.0,
)
RECALL_NO_CLOCK = RECALL

_MEANING = {
    "bias": "log odds where nothing speaks for or against; all terms add up, before any pick",
    "distance": "how near the node is, by the match basin",
    "this node": "how this run fared with the very node, over the last metres",
    "hour": "difference in time of day to the node's drive",
    "company": "how past drives that fared like this one fared with the node",
    "this run": "how this run fared with the node's drive, over the last metres",
}
_PSEUDO = 0.5
_NOBODY = 1.0
_PICKS = 8
_SHORTLIST = 32
# A match that is all but ruled out by its distance is no more than that.
_LEAST_RATE = 1e-4
# Beyond so many hours the light is another anyway; an unknown hour is as far as the average one.
_FARTHEST_H, _UNKNOWN_H = 8.0, 4.0
# The newest of this run's attempts are enough: 20 m at four attempts every 0.7 m.
_MOST_ATTEMPTS = 128


@dataclass(frozen=True, slots=True, eq=False)
class RecallJudgement:
    """What Γ(recall) thinks of the candidates of one frame.

    Attributes:
        order: (Y,) int64, rows best first.
        chances: (Y,) of success when picked, all picked before supposed to have failed.
        company: (Y,) share of like-minded past drives that match the node.
        terms: name → (Y,), the log odds of each term at first; they add up.
        viewers: (V,) weight of each past drive of the lessons.
    """

    order: NDArray[np.int64]
    chances: Array
    company: Array
    terms: dict[str, Array]
    viewers: Array


class RecallPolicy:
    """By the chance of success under a logistic model, picked greedily and diversely.

    The log odds of a candidate add up from how far it is (log g), how past drives that are like
    this one fared with it (`company`), how this run fared with its session and with itself, and
    the difference in hour of day. Past drives are weighed by how well what they matched, and
    failed to match, explains what this run did. Each pick is made as if those before it had
    failed: what would fail with them counts less.

    Args:
        clock: whether it may know the time of day.
        constants: None for those that ship with the package.
    """

    def __init__(self, *, clock: bool = True, constants: RecallConstants | None = None) -> None:
        self.name = "recall" if clock else "recall-no-clock"
        self._clock = clock
        self._constants = constants or (RECALL if clock else RECALL_NO_CLOCK)

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        canonical = order_by(context)
        order: NDArray[np.int64] = canonical[self._judge(context, canonical)[0][0]]
        return order

    def judge(self, context: RankingContext) -> RecallJudgement:
        """The ranking with its reasons."""
        c, canonical = self._constants, order_by(context)
        found, fixed = self._judge(context, canonical)
        order, chances, company, own, node, viewers = found
        share = np.clip(company, 1e-3, 1 - 1e-3)
        terms = {
            **fixed,
            "company": c.company * np.log(share / (1 - share)),
            "this run": c.own * own,
            "this node": c.node * node,
        }
        rows = np.empty_like(canonical)
        rows[canonical] = np.arange(len(canonical))
        return RecallJudgement(
            canonical[order],
            chances[rows],
            company[rows],
            {name: values[rows] for name, values in terms.items()},
            viewers,
        )

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        judged = self.judge(context)
        return Reasons(
            judged.terms, {name: _MEANING[name] for name in judged.terms}, judged.chances
        )

    def _judge(
        self, context: RankingContext, canonical: NDArray[np.int64]
    ) -> tuple[_Judged, dict[str, Array]]:
        """What the core says of the candidates, nearest first, and the terms given to it."""
        c, graph = self._constants, context.graph
        nodes = context.neighbourhood.nodes[canonical]
        rates = context.success_rates()[canonical]
        fixed = self._fixed_terms(context, nodes, rates)
        run = context.run.newest(_MOST_ATTEMPTS)
        judged = _core.recall_order(
            context.background.lessons.table,
            run.nodes,
            run.driven_m - run.at_m,
            run.rates,
            run.accepted,
            self._prior(context),
            nodes,
            rates,
            sum(fixed.values(), np.zeros(len(nodes))),
            graph.sessions,
            graph.session_count,
            company=c.company,
            own=c.own,
            node=c.node,
            own_m=c.own_m,
            node_m=c.node_m,
            viewers_m=c.viewers_m,
            trust=c.trust,
            nobody=_NOBODY,
            unknown_base=UNKNOWN_BASE,
            pseudo=_PSEUDO,
            regret=c.regret,
            picks=_PICKS,
            shortlist=_SHORTLIST,
        )
        return judged, fixed

    def _fixed_terms(
        self, context: RankingContext, nodes: NDArray[np.int32], rates: Array
    ) -> dict[str, Array]:
        """Log odds from bias, distance and hour."""
        c = self._constants
        terms = {
            "bias": np.full(len(nodes), c.bias),
            "distance": c.offset * np.log(np.maximum(rates, _LEAST_RATE)),
        }
        if self._clock and context.hour is not None:
            sessions = context.graph.sessions[nodes]
            hours = context.background.times.hours(context.graph, sessions)
            terms["hour"] = c.hour * _capped(hour_difference(hours, context.hour))
        return terms

    def _prior(self, context: RankingContext) -> Array:
        """(V,) log weights of past drives before any evidence; the live one is none of them."""
        lessons = context.background.lessons
        prior = np.zeros(len(lessons.viewers))
        if self._clock and context.hour is not None:
            prior = self._constants.viewer_hour * _capped(
                hour_difference(lessons.hours, context.hour)
            )
        own = lessons.number(context.own_path)
        if own is not None:
            prior[own] = -np.inf
        return prior


def _capped(apart_h: Array) -> Array:
    return np.where(np.isnan(apart_h), _UNKNOWN_H, np.minimum(apart_h, _FARTHEST_H))
