"""Baselines that Engram's ranking policies are measured against.

They join `engram.ranking` by the entry points "engram.policies", as anybody's policy can.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError
from engram.graph.basin import BASIN_LEVEL
from engram.graph.clock import day_of, hour_of_day
from engram.graph.model import NodeId, path_id
from engram.places.words import NodeWords
from engram.ranking.context import RankingContext, Reasons, order_by
from engram.ranking.policies import PathPolicy, evidence_of
from engram.ranking.recent import RunAttempts

IN_TURNS = (
    "the drives take turns, each with its nearest node, then with its second nearest, and so on"
)


def round_robin(context: RankingContext, *keys: NDArray[np.generic]) -> NDArray[np.int64]:
    """The sessions of the candidates in turn, each with its nearest node first (method §4).

    In each round sessions stand by the keys, (Y,) each and equal for all nodes of one session;
    ties by distance, then by UUID. A policy that knows which experience is best, but not which
    node of it, would otherwise spend its budget on one experience's nodes from near to far.
    """
    nearest_first = order_by(context)
    groups = context.sessions[nearest_first]
    by_group = np.argsort(groups, kind="stable")
    grouped = groups[by_group]
    place = np.arange(len(groups))
    is_first = np.diff(grouped, prepend=-1) != 0
    first = np.maximum.accumulate(np.where(is_first, place, 0))
    turn = np.empty(len(groups))
    turn[nearest_first[by_group]] = place - first
    return order_by(context, turn, *keys)


# An experience looks like its nodes within so many metres do (method §4).
_HERE_M = 2.0


class BagOfWordsPolicy:
    """By the cosine of the live frame's words and each experience's words here, round robin.

    Source: method §4; MacTavish, Paton, Barfoot, Visual triage: a bag-of-words experience selector
    for long-term visual route following, ICRA 2017. Without a vocabulary all are alike.
    """

    name = "bag-of-words"
    uses_words = True

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return round_robin(context, -experience_similarities(context))

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        meaning = {"likeness": "cosine of the frame's words and those of the node's drive here"}
        rule = f"{IN_TURNS}; most alike first within a turn"
        return Reasons({"likeness": experience_similarities(context)}, meaning, rule=rule)


def experience_similarities(context: RankingContext) -> NDArray[np.float64]:
    """(Y,) cosine, 0…1, of the live frame with the session of each candidate as it looks here.

    Vectors are idf-weighted sets of words. A session's set is the union over its nodes within
    2 m, or its nearest node where none is that near.
    """
    words, sessions = context.background.words, context.sessions
    result = np.zeros(len(sessions))
    if words is None or context.live_words is None or len(sessions) == 0:
        return result
    likeness_of = _Likeness(words, context.live_words())
    distance_m, nodes = context.neighbourhood.distance_m, context.neighbourhood.nodes
    nearest_first = np.lexsort((distance_m, sessions))
    bounds = np.flatnonzero(np.diff(sessions[nearest_first])) + 1
    for rows in np.split(nearest_first, bounds):
        away_m = distance_m[rows]
        within = int(np.searchsorted(away_m, max(_HERE_M, away_m[0]), side="right"))
        result[rows] = likeness_of(
            [context.graph.node(node).id for node in nodes[rows[:within]].tolist()]
        )
    return result


class _Likeness:
    """Cosine, 0…1, of idf-weighted sets of words with those of one frame."""

    def __init__(self, words: NodeWords, live: NDArray[np.int32]) -> None:
        self._words = words
        self._weights = words.idf**2
        self._seen = np.zeros(len(self._weights))
        self._seen[live] = self._weights[live]
        self._norm = float(np.sqrt(self._seen.sum()))
        # By word: whether a node before has it. A union by sorting takes several times as long.
        self._met = np.zeros(len(self._weights), np.bool_)

    def __call__(self, nodes: list[NodeId]) -> float:
        """Of all that some nodes show together."""
        shared = whole = 0.0
        found = (self._words.of_node(node) for node in nodes)
        sets = [one for one in found if one is not None]
        for one in sets:
            fresh = one if len(sets) == 1 else one[~self._met[one]]
            self._met[fresh] = True
            shared += float(self._seen[fresh].sum())
            whole += float(self._weights[fresh].sum())
        for one in sets:
            self._met[one] = False
        norm = self._norm * float(np.sqrt(whole))
        return shared / norm if norm > 0 else 0.0


def decay(run: RunAttempts, length_m: float) -> NDArray[np.float64]:
    """(R,) exp(−Δs / length) of the distance driven since each attempt."""
    return np.asarray(np.exp((run.at_m - run.driven_m) / length_m))


def failure_weights(run: RunAttempts) -> NDArray[np.float64]:
    """(R,) how much each failure counts against its experience: g, and 0 for successes.

    A failure far from the node was to be expected; one without a prediction counts nothing.
    """
    return np.where(run.accepted | np.isnan(run.rates), 0.0, run.rates)


Array = NDArray[np.float64]

# Source of all four: method §4.
_MEMORY_M = 8.0
_REDUNDANCY = 0.8
# Of a session that this run has not tried yet, and how many attempts that is worth.
PRIOR_RATE = 0.3
PRIOR_ATTEMPTS = 1.0


class BanditPolicy:
    """p = (a + 0.3) / (a + b + 1) · g(d), picked greedily and diversely (method §4).

    a and b are this run's successes and failures on the session that saved the candidate, decayed
    by exp(−Δs / 8 m), failures weighted by g of their distance. After each pick the other nodes
    of its session count 1 − 0.8 p, where p is what the pick itself counted then.
    """

    name = "bandit"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return _pick_diversely(context, _chances(context, *session_tallies(context)))

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        a, b = session_tallies(context)
        meaning = {
            "successes": "of this run on the node's drive, decayed over 8 m",
            "failures": "likewise, each as much as a match was likely",
        }
        return Reasons(
            {"successes": a, "failures": b},
            meaning,
            _chances(context, a, b),
            rule="best chance first; each pick takes from the chances of its own drive's others, "
            "so that a less likely node of another drive may come before them",
        )


def session_tallies(context: RankingContext) -> tuple[Array, Array]:
    """Decayed successes and failures (Y,) of this run on the session that saved each candidate."""
    graph, run = context.graph, context.run
    attempted, sessions = graph.sessions_of(run.nodes), context.sessions
    weights, count = decay(run, _MEMORY_M), graph.session_count
    successes = np.bincount(attempted, weights * run.accepted, count)[sessions]
    failures = np.bincount(attempted, weights * failure_weights(run), count)[sessions]
    return successes.astype(np.float64), failures.astype(np.float64)


def _chances(context: RankingContext, successes: Array, failures: Array) -> Array:
    rates = (successes + PRIOR_RATE * PRIOR_ATTEMPTS) / (successes + failures + PRIOR_ATTEMPTS)
    return rates * context.success_rates()


def _pick_diversely(context: RankingContext, p: NDArray[np.float64]) -> NDArray[np.int64]:
    canonical = order_by(context)  # the first of equals is the nearest, then by UUID
    left = p[canonical]
    sessions = context.sessions[canonical]
    picked = np.empty(len(left), np.int64)
    for place in range(len(left)):
        best = int(np.argmax(left))
        picked[place] = canonical[best]
        left[sessions == sessions[best]] *= 1 - _REDUNDANCY * left[best]
        left[best] = -np.inf
    return picked


# "Decayed with distance" (method §4), by as much as the bandit's memory.
_DECAY_M = 8.0


class CollaborativePolicy:
    """Experience r scores P_r / √(Q_r · Q_live), experiences round robin.

    P_r counts the recent live landmarks whose chain of matches reaches r, Q_r the landmarks that
    r saw here. Our nodes keep no links between landmarks, so both are counted in frames: a live
    frame matched with a node by a share of its landmarks, and r saved that node or matched it on
    its own drive (path memory); and nodes here that r saved or matched. Q_live is the same for
    all, and left out.

    Source: method §4; MacTavish, Paton, Barfoot, Selective memory: recalling relevant experience
    for long-term visual localization, Journal of Field Robotics 2018.
    """

    name = "collaborative"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return round_robin(context, -self._scores(context))

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        meaning = {"support": "recent matches that lead to the node's drive, by what it saw here"}
        rule = f"{IN_TURNS}; most support first within a turn"
        return Reasons({"support": self._scores(context)}, meaning, rule=rule)

    @staticmethod
    def _scores(context: RankingContext) -> NDArray[np.float64]:
        """(Y,) P / √Q of the candidate's session."""
        run, near = context.run, context.neighbourhood
        numbers, group = np.unique(context.sessions, return_inverse=True)
        share = run.inliers / np.maximum(run.landmarks, 1)
        reached = _reached(context, numbers, run.nodes) @ (
            decay(run, _DECAY_M) * run.accepted * share
        )
        seen = _reached(context, numbers, near.nodes) @ np.exp(-near.distance_m / _DECAY_M)
        return np.asarray((reached / np.sqrt(np.maximum(seen, 1e-12)))[group])


def _reached(
    context: RankingContext, sessions: NDArray[np.int32], nodes: NDArray[np.int32]
) -> NDArray[np.float64]:
    """(S, N) 1 where the session saved the node or matched it, else 0."""
    graph = context.graph
    paths = [path_id(graph.session(number)) for number in sessions]
    saved = graph.sessions_of(nodes) == sessions[:, None]
    matched = context.path_memory.on_paths(paths, nodes)
    if context.own_path in paths:
        matched[paths.index(context.own_path)] = False
    return np.asarray((saved | matched).astype(np.float64))


class NearestOfEachPolicy:
    """Round robin over the sessions, by distance within each round. A baseline (method §4)."""

    name = "nearest-of-each"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return round_robin(context)

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        meaning = {"metres": "distance of the node from where the robot is believed to be"}
        rule = f"{IN_TURNS}; nearest first within a turn"
        return Reasons({"metres": context.neighbourhood.distance_m}, meaning, rule=rule)


class OraclePolicy:
    """By whether the attempt would succeed, then inliers, then distance (method §4)."""

    name = "oracle"
    looks_ahead = True

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        if context.foresee is None:
            raise ConfigError(
                "the policy oracle needs the matches in advance, and this context has none; "
                "use it in engram lab evaluate, and another policy for a drive"
            )
        known = context.foresee()
        return order_by(context, ~known.accepted, -known.inliers)


class RandomPolicy:
    """A shuffle that depends on the seed, the frame's stamp and the set of candidates only."""

    name = "random"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        rng = np.random.default_rng([context.seed, context.stamp_ns % 2**64])
        # From a canonical order, so that it does not matter how the search came upon the rows.
        return rng.permutation(order_by(context))


class TimeOfDayPolicy:
    """By difference in hour of day, then by age, experiences round robin (method §4).

    Experiences whose hour is unknown stand behind those of any known hour; if the live frame's
    own is unknown, none has a difference and age alone decides. A frame of unknown date counts as
    of the day of the newest drive.
    """

    name = "time-of-day"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return round_robin(context, *self._differences(context))  # what is no number stands last

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        apart_h, age_days = self._differences(context)
        meaning = {
            "hours apart": "difference in time of day to the node's drive",
            "days apart": "difference in date",
        }
        rule = f"{IN_TURNS}; fewest hours apart first within a turn, then fewest days"
        return Reasons({"hours apart": apart_h, "days apart": age_days}, meaning, rule=rule)

    @staticmethod
    def _differences(context: RankingContext) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(Y,) hours, 0 to 12, and days."""
        numbers, group = np.unique(context.sessions, return_inverse=True)
        began = np.array([_began(context, number) for number in numbers.tolist()])
        hours, days = began.reshape(-1, 2)[group].T
        today = np.fmax.reduce(days, initial=-np.inf) if context.day is None else context.day
        age_days = np.abs(today - days)
        if context.hour is None:
            return np.zeros(len(group)), age_days
        apart_h = np.abs(hours - context.hour) % 24
        return np.minimum(apart_h, 24 - apart_h), age_days


def _began(context: RankingContext, number: int) -> tuple[float, float]:
    """Hour of day and days since 1970 at which a session began; NaN where it is not known."""
    session = context.background.sessions.get(context.graph.session(number))
    if session is None:
        return np.nan, np.nan
    hour, day = hour_of_day(session, session.start_ns), day_of(session, session.start_ns)
    return np.nan if hour is None else hour, np.nan if day is None else day


class PathNearPolicy:
    """By the formula of [L15 §V] within the match basin; then the rest by distance.

    The formula ignores distance: over the whole search radius it may prefer a node 8 m away to one
    of the same experience at 1 m. So it ranks only within the match basin, where g(d) >= 0.6: one
    reading of the paper's "local metric neighbourhood".
    """

    name = "path-near"

    def __init__(self, alpha: float = 1.0, gamma: float = 1.0) -> None:
        self._alpha, self._gamma = alpha, gamma

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        whole = PathPolicy(self._alpha, self._gamma).reasons(context)
        rule = (
            f"highest score first for g of {BASIN_LEVEL:g} or more; then the others, nearest first"
        )
        return replace(whole, rule=rule)

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return context.path_memory.order(
            context.as_seen,
            evidence_of(context, self._alpha, self._gamma),
            context.basin,
            BASIN_LEVEL,
        )


# What the studies run unless told, in the order of their tables.
STUDIED = (
    "distance",
    PathNearPolicy.name,
    "path",
    RandomPolicy.name,
    OraclePolicy.name,
    TimeOfDayPolicy.name,
    BagOfWordsPolicy.name,
    CollaborativePolicy.name,
    NearestOfEachPolicy.name,
    BanditPolicy.name,
    "recall",
)
