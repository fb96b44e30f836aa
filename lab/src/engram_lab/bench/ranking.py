"""Ranking on a synthetic map: 200 candidates, 1,000 recent attempts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext
from engram.ranking.policies import policy_named
from engram_lab.bench.data import BenchData
from engram_lab.bench.plain import PlainPipeline
from engram_lab.bench.stage import Prepared
from engram_lab.bench.synthetic import SyntheticPlace

_CANDIDATES, _OBSERVED = 200, 1000
_INPUTS = 1000
# Of each input the best of so many runs counts: what the machine does besides is not the policy's.
_BEST_OF = 10


def prepare_ranking(
    data: BenchData, plain: PlainPipeline | None, *, policy: str, paths: int
) -> Prepared:
    """Order the candidates of 1,000 situations drawn at random, with `paths` paths in memory.

    A drive's situations are like each other, these are not: what a policy keeps from frame to
    frame helps it only within the ten runs of one input. The reference of `path-near` works the
    formula out in NumPy, over 150 paths only: over 10,000 it takes a hundred times as long.
    """
    del data, plain
    place = SyntheticPlace(paths)
    contexts = [place.context(_CANDIDATES, _OBSERVED) for _ in range(_INPUTS)]
    ranking = policy_named(policy)

    def ours(i: int) -> dict[str, int]:
        order = ranking.rank(contexts[i % _INPUTS])
        return {"paths": paths, "candidates": len(order), "observed": _OBSERVED}

    if policy != "path-near" or paths > 1000:
        return Prepared(ours, best_of=_BEST_OF)
    formula = PlainFormula(place)

    def reference(i: int) -> dict[str, int]:
        order = formula.rank(contexts[i % _INPUTS])
        return {"paths": paths, "candidates": len(order), "observed": _OBSERVED}

    return Prepared(ours, reference, best_of=_BEST_OF)


class PlainFormula:
    """[L15 §V] as one would write it in NumPy, over a dense table of who was where."""

    def __init__(self, place: SyntheticPlace) -> None:
        every = np.arange(len(place.graph), dtype=np.int32)
        self._paths = place.memory.paths
        self._on = place.memory.on_paths(self._paths, every).T.astype(np.float32)

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """Rows, most promising first."""
        return np.lexsort((context.neighbourhood.distance_m, -self.scores(context)))

    def scores(self, context: RankingContext) -> NDArray[np.float32]:
        """(Y,) log posterior up to a common constant."""
        on = self._on
        if context.own_path is not None:
            on = np.delete(on, self._paths.index(context.own_path), axis=1)
        nodes, seen = context.neighbourhood.nodes, context.observations
        theta = on[nodes] @ on[seen.nodes].T + 1
        theta /= theta.sum(axis=1, keepdims=True)
        score = np.log(np.where(seen.succeeded, theta, 1 - theta)).sum(axis=1)
        if context.reference is not None:
            score += np.log(on[nodes] @ on[context.reference] + 1)
        return np.asarray(score, np.float32)
