"""Γ(collaborative): experiences that recent matches lead to first [MacTavish 2018]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.graph.model import path_id
from engram.ranking.context import RankingContext
from engram.ranking.reasons import Reasons
from engram_lab.policies.evidence import decay
from engram_lab.policies.turns import IN_TURNS, round_robin

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
