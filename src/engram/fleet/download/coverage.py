"""The expected share of a mission's route with a match, given a subset of a map.

Past drives model the mission: each passed places of the map in the light and weather of its own
day. A node matches there under two conditions. First, its session looks alike, with probability
a(s, e) for the past session s and the session e that saved the node. Second, this attempt succeeds,
with probability g(d) at the node's distance d, metres. The first event is common to all nodes of
a session, the second is independent for each node, and sessions are independent of each other:

    P(match) = 1 − Π_e (1 − a(s, e) · (1 − Π_{n of e} (1 − g(d_n)))).

Each past drive is weighted by how closely its daylight resembles the mission's (`daylight`), and
counts only at the places that it passed.

a is estimated from remembered attempts (`affinity`): the successes of s on nodes of e over the
number that g alone predicts. g is the shipped basin. The basin learnt from the map's attempts is
biased here, since far nodes are attempted only after near ones have failed.

P is monotone and submodular in the set of nodes, so the greedy choice of the best node per byte is
near-optimal (Leskovec et al., "Cost-effective outbreak detection in networks", 2007).

The interval of a forecast: what a mission will miss, calibrated on missions in other towns.
`Coverage` expects a share of the route without a match, and its level is too dark in dry weather
and too bright in wet. So a mission is compared with those that calibration met: in the same kind of
weather, in a map of about as many drives, in the light of one of them or not, and with about as
much expected to be lost by the nodes left out. The table below says what four in five of those
missed. Where calibration met too few, or their towns differ too much, nothing is promised.

Weights of past drives for a mission, by the hour of day and the height of the sun. The same hour is
day in June and night in November, so drives of other seasons are compared by the height of the sun.
Maps hold no latitude. It is estimated as the one under which differences in the sun's height best
explain which sessions matched which nodes. It need not be exact. If hours explain the successes as
well (drives of one month, none at night, no attempts), only the hour counts.

Affinity of sessions: how often nodes that one session saved match drives like another. Estimated
from remembered attempts, or from the matches on a path if no attempts were kept.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass
from datetime import date
from enum import StrEnum
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.part import Mask, Stock
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.basin import MatchBasin
from engram.graph.clock import day_of_year, hour_of_day, sun_height_deg
from engram.graph.model import PathEntryKind, path_id
from engram.graph.neighbourhood import Search, SearchConfig

Array = NDArray[np.float64]

# Hours over which affinity falls to 1/e: inliers fall from 138 to 28 within five hours (simulated
# drives, world 5).
_DECAY_H = 5.0
_HOUR_BINS = 13
# Pseudo-counts: the weight of each prior, in attempts.
_PAIR_PRIOR = 4.0
_HOUR_PRIOR = 20.0
_WORTH_PRIOR = 20.0
_UNKNOWN_AFFINITY = 0.5
_OWN_AFFINITY = 0.5
_MOST = 0.98


def affinities(stock: Stock, basin: MatchBasin) -> Array:
    """(S, S) a(s, e): the affinity of a session like s to the nodes of session e, in (0, 1).

    Estimated from remembered attempts, or from the matches on a path if no attempts were kept. A
    pair with few attempts falls back on the average for its difference in hours, scaled by how
    well e matched the others. Thus drives in rain or at night that were never matched score low.
    """
    count = len(stock.sessions)
    won, expected = tallies(stock, basin)
    apart = hours_apart(stock)
    others = ~np.eye(count, dtype=np.bool_)
    by_hour = _by_hour(won, expected, apart, others)
    known = np.isfinite(apart)
    bins = np.where(known, np.nan_to_num(apart), 0).round().astype(np.int64)
    average = np.where(known, by_hour[bins], _overall(won, expected, others))
    prior = np.minimum(average * _worth(won, expected * average, others), _MOST)
    found = (won + _PAIR_PRIOR * prior) / (expected + _PAIR_PRIOR)
    # No drive has tested a session's nodes on itself, so its own attempts say little about the
    # next drive in its light.
    found[~others] = _OWN_AFFINITY
    return np.asarray(np.clip(found, 1.0 - _MOST, _MOST))


def _worth(won: Array, expected: Array, others: Mask) -> Array:
    """(S,) success of the others on each session's nodes, relative to the average of such pairs."""
    wins = np.where(others, won, 0.0).sum(axis=0)
    tries = np.where(others, expected, 0.0).sum(axis=0)
    return np.asarray((wins + _WORTH_PRIOR * _UNKNOWN_AFFINITY) / (tries + _WORTH_PRIOR))


def tallies(stock: Stock, basin: MatchBasin) -> tuple[Array, Array]:
    """(S, S) successes of s on nodes of e, and the number that the basin g alone predicts."""
    count = len(stock.sessions)
    won, expected = np.zeros((count, count)), np.zeros((count, count))
    made = stock.attempts
    if len(made):
        rate = basin.success_rate(made.along_m.astype(float), made.across_m.astype(float))
        pairs = (made.session, stock.session_of[made.node])
        np.add.at(won, pairs, made.accepted)
        np.add.at(expected, pairs, rate)
    remembered = set(np.unique(made.session).tolist())
    by_path = {path_id(session.id): at for at, session in enumerate(stock.sessions)}
    for entry in stock.entries:
        at = by_path.get(entry.path)
        if at is not None and at not in remembered and entry.kind is not PathEntryKind.SAVED:
            other = stock.session_of[stock.index[entry.node]]
            won[at, other] += 1
            expected[at, other] += 1
    return won, expected


def hours_apart(stock: Stock) -> Array:
    """(S, S) difference in hour of day, 0 to 12 hours; NaN if either is unknown."""
    hours = np.array(
        [
            np.nan if (hour := hour_of_day(session, session.start_ns)) is None else hour
            for session in stock.sessions
        ],
        np.float64,
    )
    apart = np.abs(hours[:, None] - hours[None, :])
    return np.asarray(np.minimum(apart, 24 - apart))


def _by_hour(won: Array, expected: Array, apart: Array, others: Mask) -> Array:
    """(13,) average affinity of two sessions by their difference in hours, 0 to 12."""
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


# A drive three hours away counts 60 % of one at the same hour, and every drive a little, since the
# hour does not determine the weather. Source: lab/reports/constants.md.
_MISSION_H = 3.0
_LEAST_WEIGHT = 0.1
# Standard deviations if the sun's height is known: the hour then only separates morning from
# evening. Source: lab/reports/constants.md.
_SUN_DEG = 10.0
_SIDE_H = 4.0
_LEAST_SIDE = 0.3
_LEAST_SUN_WEIGHT = 0.05
# Heights are clipped to these.
_NIGHT_DEG, _NOON_DEG = -10.0, 45.0
# The range of heights that decides whether two sessions match at all: from civil dusk to a low sun.
# Source: lab/reports/constants.md.
DUSK_DEG, LOW_DEG = -6.0, 10.0
_LATITUDES_DEG = (-60.0, -52.5, -45.0, -37.5, -30.0, -15.0, 0.0, 15.0, 30.0, 37.5, 45.0, 52.5, 60.0)
# Most attempts of one pair of sessions that count: more repeat the same light.
_PAIR_ATTEMPTS = 20.0
# Differences in hours are clipped to this.
_FAR_H = 8.0
# Least advantage in log likelihood over the model by hours, for which a latitude is accepted.
# Source: lab/reports/constants.md.
_LEAST_EVIDENCE = 10.0
# Most sessions in the fit, those with most attempts first: its cost grows with their cube.
_JUDGED_SESSIONS = 120
_ROUNDS = 15
_PRIORS = (0.01, 0.04, 1.0)  # precisions: level, slope, each session's own


def importance(stock: Stock, options: DownloadOptions) -> Array:
    """(S,) weight of each past session for a mission; all 1 if the mission has no time."""
    if options.depart_h is None:
        return np.ones(len(stock.sessions))
    hours = np.array(
        [_nan(hour_of_day(session, session.start_ns)) for session in stock.sessions], np.float64
    )
    latitude_deg = None if not np.isfinite(hours).all() else latitude_of(stock, options)
    if latitude_deg is None:
        return _near_in_hours(hours, options, _MISSION_H) + _LEAST_WEIGHT
    height = np.clip(_heights(stock, hours, latitude_deg), _NIGHT_DEG, _NOON_DEG)
    low, high = _mission_heights(stock, options, latitude_deg)
    apart_deg = np.maximum(np.maximum(low - height, height - high), 0.0)
    side = (_near_in_hours(hours, options, _SIDE_H) + _LEAST_SIDE) / (1 + _LEAST_SIDE)
    return np.asarray(np.exp(-0.5 * (apart_deg / _SUN_DEG) ** 2) * side + _LEAST_SUN_WEIGHT)


def light_apart_deg(stock: Stock, options: DownloadOptions) -> float | None:
    """How much the height of the sun on the mission differs from that on the drive nearest to it.

    Returns:
        Degrees, between dusk and a low sun, beyond which light hardly changes; None if hours or
        latitude are unknown.
    """
    hours = np.array(
        [_nan(hour_of_day(session, session.start_ns)) for session in stock.sessions], np.float64
    )
    if options.depart_h is None or not np.isfinite(hours).all():
        return None
    latitude_deg = latitude_of(stock, options)
    if latitude_deg is None:
        return None
    height = np.clip(_heights(stock, hours, latitude_deg), DUSK_DEG, LOW_DEG)
    ends = np.clip(_mission_heights(stock, options, latitude_deg), DUSK_DEG, LOW_DEG)
    return float(np.abs(np.subtract.outer(ends, height)).min(axis=1).max())


def nearest_hours(stock: Stock, options: DownloadOptions) -> float:
    """Hours from a mission's start to the time of day of the nearest drive; infinite if unknown."""
    starts = [hour_of_day(session, session.start_ns) for session in stock.sessions]
    if options.depart_h is None:
        return np.inf
    apart = [
        abs((options.depart_h - start + 12) % 24 - 12) for start in starts if start is not None
    ]
    return min(apart, default=np.inf)


def latitude_of(stock: Stock, options: DownloadOptions) -> float | None:
    """Latitude of the fleet, degrees: as given, else estimated; None if not determined."""
    if options.latitude_deg is not None:
        return options.latitude_deg
    return learnt_latitude(stock)


def learnt_latitude(stock: Stock) -> float | None:
    """The latitude under which the sun's height best explains which sessions matched which nodes.

    For each latitude, a logistic model of the successes of all pairs of sessions is fitted, with a
    term for each of the two and one for their difference in the sun's height.

    Returns:
        Degrees, one of a dozen; None if hours explain the successes as well.
    """
    if not stock.sessions:
        return None
    focal_px = float(np.median([camera.fx for camera in stock.cameras.values()]))
    won, tried = tallies(stock, MatchBasin.of(focal_px))
    hours = np.array(
        [_nan(hour_of_day(session, session.start_ns)) for session in stock.sessions], np.float64
    )
    np.fill_diagonal(tried, 0.0)
    evidence = (tried.sum(axis=0) + tried.sum(axis=1)) * np.isfinite(hours)
    judged = np.sort(np.argsort(-evidence, kind="stable")[:_JUDGED_SESSIONS])
    pairs = _Pairs.of(won[np.ix_(judged, judged)], tried[np.ix_(judged, judged)])
    if not len(pairs.tried):
        return None
    hours_apart = np.abs(hours[judged, None] - hours[None, judged])
    by_hours, _ = pairs.fit(np.minimum(np.minimum(hours_apart, 24 - hours_apart), _FAR_H) / _FAR_H)
    fits = []
    for latitude_deg in _LATITUDES_DEG:
        height = np.clip(_heights(stock, hours, latitude_deg), DUSK_DEG, LOW_DEG)[judged]
        apart = np.abs(height[:, None] - height[None, :]) / (LOW_DEG - DUSK_DEG)
        fits.append((*pairs.fit(apart), latitude_deg))
    likelihood, slope, latitude = max(fits)
    return latitude if slope > 0 and likelihood - by_hours > _LEAST_EVIDENCE else None


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Successes of sessions on nodes of others: receiver, donor, successes, attempts."""

    sessions: int
    receiver: NDArray[np.intp]
    donor: NDArray[np.intp]
    won: Array
    tried: Array

    @staticmethod
    def of(won: Array, tried: Array) -> _Pairs:
        receiver, donor = np.nonzero(tried > 1)
        count = tried[receiver, donor]
        share = np.clip(won[receiver, donor] / count, 0.0, 1.0)
        count = np.minimum(count, _PAIR_ATTEMPTS)
        return _Pairs(len(won), receiver, donor, share * count, count)

    def fit(self, apart: Array) -> tuple[float, float]:
        """Penalised log likelihood, and the slope of the successes, by Newton's method.

        Args:
            apart: (S, S) difference of two sessions, about 0 to 1.
        """
        rows = np.arange(len(self.tried))
        terms = np.zeros((len(rows), 2 + 2 * self.sessions))
        terms[:, 0] = 1.0
        terms[:, 1] = -apart[self.receiver, self.donor]
        terms[rows, 2 + self.receiver] = 1.0
        terms[rows, 2 + self.sessions + self.donor] = 1.0
        level, slope, each = _PRIORS
        precision = np.concatenate([[level, slope], np.full(2 * self.sessions, each)])
        weights = np.zeros(len(precision))
        for _ in range(_ROUNDS):
            rate = _logistic(terms @ weights)
            spread = self.tried * rate * (1 - rate)
            curvature = (terms * spread[:, None]).T @ terms + np.diag(precision)
            uphill = terms.T @ (self.won - self.tried * rate) - precision * weights
            weights += np.clip(np.linalg.solve(curvature, uphill), -2.0, 2.0)
        rate = np.clip(_logistic(terms @ weights), 1e-6, 1 - 1e-6)
        likelihood = self.won @ np.log(rate) + (self.tried - self.won) @ np.log(1 - rate)
        return float(likelihood - 0.5 * precision @ weights**2), float(weights[1])


def _near_in_hours(hours: Array, options: DownloadOptions, spread_h: float) -> Array:
    """(S,) 1 within the mission's hours, falling with the distance from them; 0 if unknown."""
    assert options.depart_h is not None
    arrive_h = options.depart_h if options.arrive_h is None else options.arrive_h
    length_h = (arrive_h - options.depart_h) % 24
    since_h = (hours - options.depart_h) % 24
    apart_h = np.where(since_h <= length_h, 0.0, np.minimum(since_h - length_h, 24 - since_h))
    return np.asarray(np.nan_to_num(np.exp(-0.5 * (apart_h / spread_h) ** 2)))


def _mission_heights(
    stock: Stock, options: DownloadOptions, latitude_deg: float
) -> tuple[float, float]:
    """The lowest and the highest sun of the mission."""
    assert options.depart_h is not None
    if options.date is not None:
        day = float(date.fromisoformat(options.date).timetuple().tm_yday - 1)
    else:
        day = day_of_year(max(session.begin_ns for session in stock.store.sessions.values()))
    arrive_h = options.depart_h if options.arrive_h is None else options.arrive_h
    span = np.linspace(0.0, (arrive_h - options.depart_h) % 24, 25)
    hours = (options.depart_h + span) % 24
    height = np.clip(sun_height_deg(day, hours, latitude_deg), _NIGHT_DEG, _NOON_DEG)
    return float(height.min()), float(height.max())


def _heights(stock: Stock, hours: Array, latitude_deg: float) -> Array:
    days = np.array([day_of_year(session.begin_ns) for session in stock.sessions], np.float64)
    return sun_height_deg(days, hours, latitude_deg)


def _logistic(value: Array) -> Array:
    return np.asarray(1 / (1 + np.exp(-value)), np.float64)


def _nan(value: float | None) -> float:
    return np.nan if value is None else value


# Places a metre apart, the spacing of saved nodes (method §5).
_PLACE_M = 1.0
# Nodes farther than this many basin widths are ignored.
_REACH = 2.0
_GATE_RAD = float(np.deg2rad(60.0))
# Nodes lie near their expected position: no slack.
_STRICT = SearchConfig(slack_sigmas=0.0, slack_m=0.0)
# Attempts on nodes of one session fail together more often than independent ones:
# P(second matches | first did not) is 0.2 to 0.3 where g gives 0.5 (simulated drives, world 5).
_APART = 0.6
_LEAST_GAIN = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Demand:
    """Where the mission may go, weighted by the past drives that model it.

    Attributes:
        places: (L,) int64, dense indices of the nodes that represent places.
        weight: (L, S) weight of being there as session s: the same at all places that the
            session passed and the mission may reach, 0 elsewhere.
    """

    places: NDArray[np.int64]
    weight: Array

    @property
    def total(self) -> float:
        """Total weight of all places: the value of a mission without any match."""
        return float(self.weight.sum())

    @staticmethod
    def of(stock: Stock, options: DownloadOptions) -> Demand:
        """Places from all nodes, weights from path memory; only in the mission's area."""
        places, place_of = _places(stock)
        weight = np.zeros((len(places), len(stock.sessions)))
        counts = importance(stock, options)
        for at, session in enumerate(stock.sessions):
            nodes = stock.on_path.get(path_id(session.id), np.zeros(0, np.int64))
            weight[np.unique(place_of[nodes]), at] = counts[at]
        weight[~np.isin(np.arange(len(places)), place_of[stock.area])] = 0.0
        return Demand(places, weight)


def basin_of(cameras: Collection[StereoCamera]) -> MatchBasin:
    """The shipped basin of a map's cameras."""
    return MatchBasin.of(float(np.median([camera.fx for camera in cameras] or 1)))


def reach_of(basin: MatchBasin) -> float:
    """How far from a place, in metres, nodes count for it."""
    return max(_REACH * basin.basin_m, _PLACE_M)


def _places(stock: Stock) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Nodes at least a metre apart, and for each node the place that it is at."""
    place_of = np.full(len(stock), -1, np.int64)
    distance_m = np.full(len(stock), np.inf)
    places: list[int] = []
    for node in range(len(stock)):
        if place_of[node] >= 0:
            continue
        near = stock.graph.neighbourhood(
            node, SE3.identity(), np.zeros((6, 6)), Search(_PLACE_M, _GATE_RAD, config=_STRICT)
        )
        closer = near.distance_m < distance_m[near.nodes]
        place_of[near.nodes[closer]] = len(places)
        distance_m[near.nodes[closer]] = near.distance_m[closer]
        place_of[node], distance_m[node] = len(places), 0.0
        places.append(node)
    return np.array(places, np.int64), place_of


class Coverage:
    """The expected share of a mission's route with a match, as nodes are added one by one."""

    def __init__(self, stock: Stock, demand: Demand) -> None:
        self.demand = demand
        basin = basin_of(stock.cameras.values())
        self._affinity = affinities(stock, basin)
        self._session_of = stock.session_of
        self._reached = self._reach(stock, basin)
        self.clear()

    def clear(self) -> None:
        """Empties the subset."""
        # (L, S): weight × the chance of no match so far.
        self._missed = self.demand.weight.copy()
        # (L, S_e): the chance that an added node of session e matches, if they look alike.
        self._alike = np.zeros(self.demand.weight.shape)

    def _reach(self, stock: Stock, basin: MatchBasin) -> dict[int, tuple[NDArray[np.int64], Array]]:
        """For each node the places at which it may match, and g there."""
        found: dict[int, tuple[list[int], list[float]]] = defaultdict(lambda: ([], []))
        wanted = np.flatnonzero(self.demand.weight.sum(axis=1) > 0)
        for place in wanted.tolist():
            near = stock.graph.neighbourhood(
                int(self.demand.places[place]),
                SE3.identity(),
                np.zeros((6, 6)),
                Search(reach_of(basin), _GATE_RAD, config=_STRICT),
            )
            rates = _APART * basin.success_rate(near.along_m, near.across_m)
            for node, rate in zip(near.nodes.tolist(), rates.tolist(), strict=True):
                found[node][0].append(place)
                found[node][1].append(rate)
        return {node: (np.array(at), np.array(g)) for node, (at, g) in found.items()}

    def gain(self, node: int) -> float:
        """Increase in the expected number of places with a match if the node were added."""
        if node not in self._reached:
            return 0.0
        places, rates, before = self._state(node)
        missed = self._missed[places]
        return float((missed * (1 - self._less(node, rates, before))).sum())

    def add(self, node: int) -> None:
        """Adds a node to the subset."""
        if node not in self._reached:
            return
        places, rates, before = self._state(node)
        self._missed[places] *= self._less(node, rates, before)
        self._alike[places, self._session_of[node]] = _either(rates, before)

    def _less(self, node: int, rates: Array, before: Array) -> Array:
        """(K, S) factor on the chance of no match at the K places that a node reaches."""
        affinity = self._affinity[:, self._session_of[node]]
        now = _either(rates, before)
        return np.asarray((1 - affinity * now[:, None]) / (1 - affinity * before[:, None]))

    def _state(self, node: int) -> tuple[NDArray[np.int64], Array, Array]:
        places, rates = self._reached[node]
        return places, rates, self._alike[places, self._session_of[node]]

    @property
    def expected_missed(self) -> float:
        """Expected share of the mission's route without a match, given the nodes added so far.

        1 if the mission has no route at all.
        """
        return float(self._missed.sum() / self.demand.total) if self.demand.total else 1.0


def _either(first: Array, second: Array) -> Array:
    """P(A or B) of independent events."""
    return 1 - (1 - first) * (1 - second)


def expected_missed(coverage: Coverage, sent: Mask) -> float:
    """`Coverage.expected_missed` of a subset, (N,) bool."""
    coverage.clear()
    for node in np.flatnonzero(sent).tolist():
        coverage.add(node)
    return coverage.expected_missed


def greedy_order(
    coverage: Coverage, size_bytes: Array, spare: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Array]:
    """All nodes by gain per byte, each given those before it; then those without gain.

    Lazy: gains only fall, so a node whose recomputed gain is still the highest is the best. Ties go
    to the lower index.

    Args:
        size_bytes: (N,) float64, bytes of each node.
        spare: (N,) int64, all nodes in the order in which they fill the rest.

    Returns:
        (N,) int64, the nodes in order; (N,) float64, the ratio of the gain that each adds to its
        bytes.
    """
    coverage.clear()
    waiting = [(-coverage.gain(node) / size, node) for node, size in enumerate(size_bytes)]
    heapq.heapify(waiting)
    order: list[int] = []
    gains: list[float] = []
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
        gains.append(-entry[0])
    taken = set(order)
    order += [node for node in spare.tolist() if node not in taken]
    return np.array(order, np.int64), np.array(gains + [0.0] * (len(order) - len(gains)))


Interval: TypeAlias = tuple[float, float]

# Share of missions that the interval holds.
LEVEL = 0.8
# Losses by nodes left out, of the expected share, between which missions are alike.
BINS = (0.0, 0.02, 0.15, 0.3, 0.45, 0.6, 0.75, 1.0)
# Maps of fewer drives are calibrated apart.
MOST_DRIVES = 8
# A mission is in the light of a drive if the sun stands as high, to so many degrees between dusk
# and a low sun; without a known latitude, if it is within so many hours.
ALIKE_DEG = 4.0
ALIKE_H = 3.0


class Weather(StrEnum):
    """What the camera looks through."""

    DRY = "dry"
    SHOWERS = "showers"
    RAIN = "rain"


@dataclass(frozen=True, slots=True)
class Light:
    """Whether the map contains drives in the mission's light.

    Attributes:
        alike: whether some drive of the map had the same; None if that is unknown.
    """

    alike: bool | None

    @staticmethod
    def of(stock: Stock, options: DownloadOptions) -> Light:
        """By the height of the sun where the latitude is known, else by the hour."""
        apart_deg = light_apart_deg(stock, options)
        if apart_deg is not None:
            return Light(apart_deg <= ALIKE_DEG)
        return Light(True if nearest_hours(stock, options) <= ALIKE_H else None)


def _few(*known: Interval | None) -> tuple[Interval | None, ...]:
    """Intervals of the first bins; none for the others."""
    return known + (None,) * (len(BINS) - 1 - len(known))


# (low, high) of each bin, by weather, by whether a drive of the map had the mission's light, and by
# whether the map has few drives. Source: `engram_lab.fits.forecasts fit`, lab/reports/downloads.md.
INTERVALS: dict[tuple[Weather, bool, bool], tuple[Interval | None, ...]] = {
    (Weather.DRY, True, True): _few((0.0, 0.01), (0.0, 0.08)),
    (Weather.DRY, True, False): (
        (0.0, 0.005),
        (0.0, 0.005),
        (0.0, 0.09),
        (0.0, 0.145),
        (0.195, 0.515),
        (0.725, 0.905),
        (0.705, 1.0),
    ),
    (Weather.DRY, False, True): _few((0.165, 0.605), (0.435, 0.885)),
    (Weather.SHOWERS, True, True): ((0.315, 0.535),) * (len(BINS) - 1),
    (Weather.RAIN, False, True): ((0.995, 1.0),) * (len(BINS) - 1),
}


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a mission will miss, for each kind of weather that it may meet.

    Attributes:
        expected: share of the route without a match that `Coverage` expects.
        missed: ends of the interval of the share by weather; None where it is not known.
    """

    expected: float
    missed: dict[Weather, Interval | None]

    @staticmethod
    def of(expected: float, lost: float, drives: int, light: Light) -> Forecast:
        """The forecast of one mission.

        Args:
            expected: share of the route without a match by `Coverage`.
            light: whether the map contains drives in the mission's light.
        """
        place = int(np.digitize(lost, BINS[1:-1]))
        missed: dict[Weather, Interval | None] = dict.fromkeys(Weather)
        if light.alike is not None:
            for weather in Weather:
                table = INTERVALS.get((weather, light.alike, drives < MOST_DRIVES), _few())
                missed[weather] = table[place]
        return Forecast(expected, missed)

    def text(self) -> str:
        """The forecast as one line of text."""
        shares = ", ".join(
            f"{weather} "
            + ("not known" if interval is None else f"{interval[0]:.1%} to {interval[1]:.1%}")
            for weather, interval in self.missed.items()
        )
        return f"route without a match in {LEVEL:.0%} of such missions: {shares}"
