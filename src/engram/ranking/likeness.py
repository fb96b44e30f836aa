"""Visual similarity of a live frame and nodes, by their words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from engram.graph.model import NodeId
from engram.places.words import NodeWords
from engram.ranking.context import RankingContext


def likenesses(
    words: NodeWords, live: NDArray[np.int32], nodes: Sequence[NodeId]
) -> NDArray[np.float64]:
    """(Y,) float64: cosine, 0…1, of the idf-weighted word sets of a frame and each node.

    Args:
        words: gives the nodes' words.
        live: (n,) int32, the distinct words of the frame.
        nodes: Y nodes; damaged ones count as without words.
    """
    weights = words.idf**2
    seen = np.zeros(len(weights))
    seen[live] = weights[live]
    nothing = np.zeros(0, np.int32)
    found = [words.of_node(node) for node in nodes]
    sets = [nothing if one is None else one for one in found]
    met = np.concatenate([*sets, nothing])
    place = np.repeat(np.arange(len(sets)), [len(one) for one in sets])
    shared, whole = (
        np.bincount(place, values[met], minlength=len(sets)) for values in (seen, weights)
    )
    norms = float(np.sqrt(seen.sum())) * np.sqrt(whole)
    return np.divide(shared, norms, out=np.zeros(len(sets)), where=norms > 0)


def standard_likenesses(context: RankingContext) -> NDArray[np.float64]:
    """(Y,) float64: similarity of each candidate to the frame, in standard deviations over all.

    Zeros without a vocabulary, and if all are equally similar.
    """
    words, nodes = context.background.words, context.neighbourhood.nodes
    if words is None or context.live_words is None or len(nodes) == 0:
        return np.zeros(len(nodes))
    ids = [context.graph.node(node).id for node in nodes.tolist()]
    alike = likenesses(words, context.live_words(), ids)
    alike -= alike.mean()
    deviation = alike.std()
    return alike / deviation if deviation > 1e-9 else np.zeros(len(nodes))
