"""Experiences taking turns: what policies have in common that rank experiences, not nodes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, order_by

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
