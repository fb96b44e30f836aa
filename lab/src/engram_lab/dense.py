"""FAB-MAP without an inverted index: what the query costs then, as a reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.places.recognisers import FabMapConfig, ObservationModel
from engram.places.vocabulary import Vocabulary


class DenseTable:
    """FAB-MAP as NumPy does it best: a row per place, one matrix-vector product per query."""

    def __init__(self, vocabulary: Vocabulary, config: FabMapConfig, places: int) -> None:
        model = ObservationModel.of(vocabulary.statistics, config.detector)
        self._unseen, self._seen = model.log_p.astype(np.float32)
        self._parents = model.parents
        self._every = np.arange(len(vocabulary))
        self._shows = np.zeros((places, len(vocabulary)), np.float32)
        self._count = 0

    def add(self, words: NDArray[np.int32]) -> None:
        """Adds a place."""
        self._shows[self._count, words] = 1
        self._count += 1

    def best(self, words: NDArray[np.int32], count: int) -> NDArray[np.int64]:
        """Numbers of the `count` most likely places, in no order."""
        z = np.zeros(len(self._parents), np.int64)
        z[words] = 1
        case = 2 * z + np.where(self._parents >= 0, z[self._parents], 0)
        unseen = self._unseen[case, self._every]
        scores = self._shows @ (self._seen[case, self._every] - unseen) + unseen.sum()
        return np.argpartition(scores, -count)[-count:]
