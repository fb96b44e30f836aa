"""How well what one session saved serves drives like another.

Learnt from remembered attempts, and from the matches on a path where no attempts were kept.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.fleet.download.stock import Mask, Stock
from engram.graph.basin import MatchBasin
from engram.graph.clock import hour_of_day
from engram.graph.model import PathEntryKind, path_id

Array = NDArray[np.float64]

# A first study of the towns: a map decays with the hour, inliers 138 to 28 within five hours.
_DECAY_H = 5.0
_HOUR_BINS = 13
# So many attempts' worth of belief in the average, before a pair of sessions speaks for itself.
_PAIR_PRIOR = 4.0
_HOUR_PRIOR = 20.0
_WORTH_PRIOR = 20.0
_UNKNOWN_AFFINITY = 0.5
_OWN_AFFINITY = 0.5
_MOST = 0.98


def affinities(stock: Stock, basin: MatchBasin) -> Array:
    """(S, S) a(s, e): how well what session e saved serves one like session s, in (0, 1).

    From remembered attempts, and from the matches on a path where no attempts were kept. What a
    pair lacks is taken from the average for its difference in hours, and from how the others got
    on with e: drives in rain or at night, with which nobody ever matched, serve nobody.
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
    # What a session saved itself was matched by nobody yet: it says little about the next drive in
    # its light. With 0.8 the promise is nearer, and a quarter of the bytes worth less (`village`).
    found[~others] = _OWN_AFFINITY
    return np.asarray(np.clip(found, 1.0 - _MOST, _MOST))


def _worth(won: Array, expected: Array, others: Mask) -> Array:
    """(S,) how well what each session saved served the others, over the average of such pairs."""
    wins = np.where(others, won, 0.0).sum(axis=0)
    tries = np.where(others, expected, 0.0).sum(axis=0)
    return np.asarray((wins + _WORTH_PRIOR * _UNKNOWN_AFFINITY) / (tries + _WORTH_PRIOR))


def tallies(stock: Stock, basin: MatchBasin) -> tuple[Array, Array]:
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


def hours_apart(stock: Stock) -> Array:
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
