"""Weights of past drives for a mission, by the hour of day and the height of the sun.

The same hour is day in June and night in November, so drives of other seasons are compared by the
height of the sun. Maps hold no latitude. It is estimated as the one under which differences in the
sun's height best explain which sessions matched which nodes. It need not be exact. If hours explain
the successes as well (drives of one month, none at night, no attempts), only the hour counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date

import numpy as np
from numpy.typing import NDArray

from engram.fleet.download.affinity import tallies
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.stock import Stock
from engram.graph.basin import MatchBasin
from engram.graph.clock import hour_of_day
from engram.graph.sun import day_of_year, sun_height_deg

Array = NDArray[np.float64]

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
    hours = np.array([_nan(hour_of_day(one, one.start_ns)) for one in stock.sessions], np.float64)
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
    hours = np.array([_nan(hour_of_day(one, one.start_ns)) for one in stock.sessions], np.float64)
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
    starts = [hour_of_day(one, one.start_ns) for one in stock.sessions]
    if options.depart_h is None:
        return np.inf
    apart = [abs((options.depart_h - one + 12) % 24 - 12) for one in starts if one is not None]
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
    focal_px = float(np.median([one.fx for one in stock.contents.cameras.values()]))
    won, tried = tallies(stock, MatchBasin.of(focal_px))
    hours = np.array([_nan(hour_of_day(one, one.start_ns)) for one in stock.sessions], np.float64)
    np.fill_diagonal(tried, 0.0)
    told = (tried.sum(axis=0) + tried.sum(axis=1)) * np.isfinite(hours)
    judged = np.sort(np.argsort(-told, kind="stable")[:_JUDGED_SESSIONS])
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
        found = np.zeros(len(precision))
        for _ in range(_ROUNDS):
            rate = _logistic(terms @ found)
            spread = self.tried * rate * (1 - rate)
            curvature = (terms * spread[:, None]).T @ terms + np.diag(precision)
            uphill = terms.T @ (self.won - self.tried * rate) - precision * found
            found += np.clip(np.linalg.solve(curvature, uphill), -2.0, 2.0)
        rate = np.clip(_logistic(terms @ found), 1e-6, 1 - 1e-6)
        likelihood = self.won @ np.log(rate) + (self.tried - self.won) @ np.log(1 - rate)
        return float(likelihood - 0.5 * precision @ found**2), float(found[1])


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
        day = day_of_year(max(one.begin_ns for one in stock.sessions))
    arrive_h = options.depart_h if options.arrive_h is None else options.arrive_h
    span = np.linspace(0.0, (arrive_h - options.depart_h) % 24, 25)
    hours = (options.depart_h + span) % 24
    height = np.clip(sun_height_deg(day, hours, latitude_deg), _NIGHT_DEG, _NOON_DEG)
    return float(height.min()), float(height.max())


def _heights(stock: Stock, hours: Array, latitude_deg: float) -> Array:
    days = np.array([day_of_year(one.begin_ns) for one in stock.sessions], np.float64)
    return sun_height_deg(days, hours, latitude_deg)


def _logistic(value: Array) -> Array:
    return np.asarray(1 / (1 + np.exp(-value)), np.float64)


def _nan(value: float | None) -> float:
    return np.nan if value is None else value
