"""What a subset of a map promises to a mission: the expected share of its way with a match.

Past drives stand for the drive to come. Each went along places of the map and was, at each, in the
light and weather of its own day. Whether a node would match there is told by two things: whether
its session looks alike there at all, with probability a(s, e) for the past session s and the
session e that saved the node; and, if so, whether this very attempt succeeds, with probability
g(d) at the node's distance d. Nodes of one session look alike or do not together; given that they
do, each is an attempt of its own; sessions are taken as independent:

    P(match) = 1 − Π_e (1 − a(s, e) · (1 − Π_{n of e} (1 − g(d_n)))).

Past drives count by how near in time of day they are to the mission, each with the places that it
itself came past: a place that one drive alone came past counts as little as that drive.

a is learnt from remembered attempts: successes of s on nodes of e over what g alone would have
given, held to the average for their difference in hour of day, and that to how others got on with
e. g has the shape of the shipped basin. The one learnt from the map's attempts will not do here:
far nodes are attempted where near ones have failed, so that it falls off a cliff.

Adding a node never lowers P, and helps the less the more is there already (monotone and
submodular), so taking the best node per byte again and again comes close to the best subset there
is (Leskovec et al., "Cost-effective outbreak detection in networks", 2007).
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.experience.basin import MatchBasin
from engram.experience.clock import hour_of_day
from engram.experience.model import PathEntryKind, path_id
from engram.fleet.mission import DownloadOptions
from engram.fleet.stock import Mask, Stock
from engram.geometry import SE3

Array = NDArray[np.float64]

# Places a metre apart, the spacing of saved nodes (SPEC §5).
_PLACE_M = 1.0
# Nodes farther than this share of the basin give nothing that counts.
_REACH = 2.0
_GATE_RAD = float(np.deg2rad(60.0))
# SPEC §4's feasibility study: a map decays with the hour, inliers 138 to 28 within five hours.
_DECAY_H = 5.0
_HOUR_BINS = 13
# So many attempts' worth of belief in the average, before a pair of sessions speaks for itself.
_PAIR_PRIOR = 4.0
_HOUR_PRIOR = 20.0
_WORTH_PRIOR = 20.0
_UNKNOWN_AFFINITY = 0.5
_OWN_AFFINITY = 0.5
# A drive three hours away counts 60 % of one at the same hour, any a little: the hour does not tell
# the weather. Chosen on one fold of `village` among 1.5 and 3 h, 0.02, 0.1 and 0.3.
_MISSION_H = 3.0
_LEAST_WEIGHT = 0.1
# Attempts on nodes of one session that looks alike fail together oftener than by chance: P(second
# matches | first did not) was 0.2 to 0.3 where g says 0.5 (`village`, 12 drives with all nodes).
_APART = 0.6
_MOST = 0.98
_LEAST_GAIN = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Demand:
    """Where and as whom the mission may find itself.

    Attributes:
        places: (L,) dense indices of the nodes that stand for places.
        weight: (L, S) how much being there as session s counts: the same at all places that the
            session came past and the mission may come to, 0 elsewhere.
    """

    places: NDArray[np.int64]
    weight: Array

    @property
    def total(self) -> float:
        """What there is to miss."""
        return float(self.weight.sum())

    @staticmethod
    def of(stock: Stock, options: DownloadOptions, where: Mask | None) -> Demand:
        """Places from all nodes, weights from path memory.

        Args:
            stock: the centre.
            options: when the mission is.
            where: (N,) nodes along its way; None for anywhere.
        """
        places, place_of = _places(stock)
        weight = np.zeros((len(places), len(stock.sessions)))
        for at, session in enumerate(stock.sessions):
            nodes = stock.on_path.get(path_id(session.id), np.zeros(0, np.int64))
            hour = hour_of_day(session, session.start_ns)
            weight[np.unique(place_of[nodes]), at] = _importance(hour, options)
        if where is not None:
            weight[~np.isin(np.arange(len(places)), place_of[where])] = 0.0
        return Demand(places, weight)


def _importance(hour: float | None, options: DownloadOptions) -> float:
    """How well a past drive stands for the mission, by its hour of day."""
    if options.start_h is None:
        return 1.0
    if hour is None:
        return _LEAST_WEIGHT
    end_h = options.start_h if options.end_h is None else options.end_h
    length_h = (end_h - options.start_h) % 24
    since_h = (hour - options.start_h) % 24
    apart_h = 0.0 if since_h <= length_h else min(since_h - length_h, 24 - since_h)
    return float(np.exp(-0.5 * (apart_h / _MISSION_H) ** 2)) + _LEAST_WEIGHT


def _places(stock: Stock) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Nodes no closer to each other than a metre, and for each node the place that it is at."""
    place_of = np.full(len(stock), -1, np.int64)
    distance_m = np.full(len(stock), np.inf)
    places: list[int] = []
    for node in range(len(stock)):
        if place_of[node] >= 0:
            continue
        near = stock.graph.neighbourhood(
            node, SE3.identity(), np.zeros((6, 6)), radius_m=_PLACE_M, view_gate_rad=_GATE_RAD,
            slack_sigmas=0.0, slack_m=0.0,
        )  # fmt: skip
        closer = near.distance_m < distance_m[near.nodes]
        place_of[near.nodes[closer]] = len(places)
        distance_m[near.nodes[closer]] = near.distance_m[closer]
        place_of[node], distance_m[node] = len(places), 0.0
        places.append(node)
    return np.array(places, np.int64), place_of


def affinities(stock: Stock, basin: MatchBasin) -> Array:
    """(S, S) a(s, e): how well what session e saved serves one like session s, in (0, 1).

    From remembered attempts, and from the matches on a path where no attempts were kept. What a
    pair lacks is taken from the average for its difference in hours, and from how the others got
    on with e: drives in rain or at night, with which nobody ever matched, serve nobody.
    """
    count = len(stock.sessions)
    won, expected = _tallies(stock, basin)
    apart = _hours_apart(stock)
    others = ~np.eye(count, dtype=np.bool_)
    by_hour = _by_hour(won, expected, apart, others)
    known = np.isfinite(apart)
    bins = np.where(known, np.nan_to_num(apart), 0).round().astype(np.int64)
    average = np.where(known, by_hour[bins], _overall(won, expected, others))
    prior = np.minimum(average * _worth(won, expected * average, others), _MOST)
    found = (won + _PAIR_PRIOR * prior) / (expected + _PAIR_PRIOR)
    # What a session saved itself says little about the next drive in its light.
    found[~others] = _OWN_AFFINITY
    return np.asarray(np.clip(found, 1.0 - _MOST, _MOST))


def _worth(won: Array, expected: Array, others: Mask) -> Array:
    """(S,) how well what each session saved served the others, over the average of such pairs."""
    wins = np.where(others, won, 0.0).sum(axis=0)
    tries = np.where(others, expected, 0.0).sum(axis=0)
    return np.asarray((wins + _WORTH_PRIOR * _UNKNOWN_AFFINITY) / (tries + _WORTH_PRIOR))


def _tallies(stock: Stock, basin: MatchBasin) -> tuple[Array, Array]:
    """(S, S) successes of s on nodes of e, and how many g alone would have given."""
    count = len(stock.sessions)
    won, expected = np.zeros((count, count)), np.zeros((count, count))
    made = stock.attempts
    if len(made):
        rate = basin.success_rate(made.along_m.astype(float), made.across_m.astype(float))
        pairs = (made.session, stock.session_of[made.node])
        np.add.at(won, pairs, made.accepted)
        np.add.at(expected, pairs, rate)
    told = set(np.unique(made.session).tolist())
    by_path = {path_id(one.id): at for at, one in enumerate(stock.sessions)}
    for entry in stock.entries:
        at = by_path.get(entry.path)
        if at is not None and at not in told and entry.kind is not PathEntryKind.SAVED:
            other = stock.session_of[stock.index[entry.node]]
            won[at, other] += 1
            expected[at, other] += 1
    return won, expected


def _hours_apart(stock: Stock) -> Array:
    """(S, S) difference in hour of day, NaN where one is not known."""
    hours = np.array(
        [
            np.nan if (hour := hour_of_day(one, one.start_ns)) is None else hour
            for one in stock.sessions
        ],
        np.float64,
    )
    apart = np.abs(hours[:, None] - hours[None, :])
    return np.asarray(np.minimum(apart, 24 - apart))


def _by_hour(won: Array, expected: Array, apart: Array, others: Mask) -> Array:
    """(13,) the average affinity of two sessions so many hours apart."""
    prior = _MOST * np.exp(-np.arange(_HOUR_BINS) / _DECAY_H)
    counted = others & np.isfinite(apart)
    bins = apart[counted].round().astype(np.int64)
    sums = np.zeros((2, _HOUR_BINS))
    np.add.at(sums[0], bins, won[counted])
    np.add.at(sums[1], bins, expected[counted])
    average = (sums[0] + _HOUR_PRIOR * prior) / (sums[1] + _HOUR_PRIOR)
    return np.asarray(np.minimum(average, _MOST))


def _overall(won: Array, expected: Array, others: Mask) -> float:
    total = float(expected[others].sum())
    share = (float(won[others].sum()) + _HOUR_PRIOR * _UNKNOWN_AFFINITY) / (total + _HOUR_PRIOR)
    return min(share, _MOST)


class Coverage:
    """The expected share of a mission's way with a match, as nodes are added one by one.

    Args:
        stock: the centre.
        demand: of the mission.

    Attributes:
        demand: of the mission.
    """

    def __init__(self, stock: Stock, demand: Demand) -> None:
        self.demand = demand
        focal_px = float(np.median([camera.fx for camera in stock.contents.cameras.values()] or 1))
        basin = MatchBasin.of(focal_px)
        self._affinity = affinities(stock, basin)
        self._session_of = stock.session_of
        self._reached = self._reach(stock, basin)
        self.clear()

    def clear(self) -> None:
        """No node is sent any more."""
        # (L, S): weight × the chance of no match so far.
        self._missed = self.demand.weight.copy()
        # (L, S_e): the chance that a node of session e that was added matches, if they look alike.
        self._alike = np.zeros(self.demand.weight.shape)

    def _reach(self, stock: Stock, basin: MatchBasin) -> dict[int, tuple[NDArray[np.int64], Array]]:
        """For each node the places that it may be matched at, and g there."""
        found: dict[int, tuple[list[int], list[float]]] = defaultdict(lambda: ([], []))
        wanted = np.flatnonzero(self.demand.weight.sum(axis=1) > 0)
        for place in wanted.tolist():
            near = stock.graph.neighbourhood(
                int(self.demand.places[place]), SE3.identity(), np.zeros((6, 6)),
                radius_m=max(_REACH * basin.basin_m, _PLACE_M), view_gate_rad=_GATE_RAD,
                slack_sigmas=0.0, slack_m=0.0,
            )  # fmt: skip
            rates = _APART * basin.success_rate(near.along_m, near.across_m)
            for node, rate in zip(near.nodes.tolist(), rates.tolist(), strict=True):
                found[node][0].append(place)
                found[node][1].append(rate)
        return {node: (np.array(at), np.array(g)) for node, (at, g) in found.items()}

    def gain(self, node: int) -> float:
        """By how many places the expected number with a match would rise."""
        if node not in self._reached:
            return 0.0
        places, rates, before = self._state(node)
        missed = self._missed[places]
        return float((missed * (1 - self._less(node, rates, before))).sum())

    def add(self, node: int) -> None:
        """The node is sent."""
        if node not in self._reached:
            return
        places, rates, before = self._state(node)
        self._missed[places] *= self._less(node, rates, before)
        self._alike[places, self._session_of[node]] = _either(rates, before)

    def _less(self, node: int, rates: Array, before: Array) -> Array:
        """(K, S) by what factor the chance of no match falls at the places that a node reaches."""
        affinity = self._affinity[:, self._session_of[node]]
        now = _either(rates, before)
        return np.asarray((1 - affinity * now[:, None]) / (1 - affinity * before[:, None]))

    def _state(self, node: int) -> tuple[NDArray[np.int64], Array, Array]:
        places, rates = self._reached[node]
        return places, rates, self._alike[places, self._session_of[node]]

    @property
    def expected_missed(self) -> float:
        """Expected share of the mission's way without a match, of what was added so far.

        1 where the mission has no way at all.
        """
        return float(self._missed.sum() / self.demand.total) if self.demand.total else 1.0


def _either(first: Array, second: Array) -> Array:
    """The chance that one of two things happens."""
    return 1 - (1 - first) * (1 - second)


def expected_missed(coverage: Coverage, sent: Mask) -> float:
    """`Coverage.expected_missed` of a subset alone."""
    coverage.clear()
    for node in np.flatnonzero(sent).tolist():
        coverage.add(node)
    return coverage.expected_missed


def greedy_order(
    coverage: Coverage, size_bytes: Array, spare: NDArray[np.int64]
) -> NDArray[np.int64]:
    """(N,) all nodes: by gain per byte, each given those before it; then what nothing asks for.

    Lazy: gains only fall, so a node whose gain is still the highest after it was worked out anew
    is the best. Ties go to the lower index.

    Args:
        coverage: of the mission; what it holds is replaced.
        size_bytes: (N,) what each node takes.
        spare: (N,) all nodes in the order in which they fill up what is left.
    """
    coverage.clear()
    waiting = [(-coverage.gain(node) / size, node) for node, size in enumerate(size_bytes)]
    heapq.heapify(waiting)
    order: list[int] = []
    while waiting:
        _, node = heapq.heappop(waiting)
        gain = coverage.gain(node)
        if gain <= _LEAST_GAIN:
            continue
        entry = (-gain / size_bytes[node], node)
        if waiting and entry > waiting[0]:
            heapq.heappush(waiting, entry)
            continue
        coverage.add(node)
        order.append(node)
    taken = set(order)
    order += [node for node in spare.tolist() if node not in taken]
    return np.array(order, np.int64)
