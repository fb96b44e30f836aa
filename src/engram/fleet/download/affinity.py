"""Affinity of sessions: how often nodes that one session saved match drives like another.

Estimated from remembered attempts, or from the matches on a path if no attempts were kept.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.fleet.download.stock import Mask, Stock
from engram.graph.basin import MatchBasin
from engram.graph.clock import hour_of_day
from engram.graph.model import PathEntryKind, path_id

Array = NDArray[np.float64]

# Hours over which affinity falls to 1/e: inliers fall from 138 to 28 within five hours.
# Source: lab/reports/constants.md.
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
    # # next drive in its light.
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
    """(S, S) difference in hour of day, 0 to 12 hours; NaN if either is unknown."""
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
