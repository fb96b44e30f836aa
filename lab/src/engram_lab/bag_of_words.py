"""Bag of words, the baseline of place recognition.

Similarity of two images' words, weighted by their rarity. A word counts once however often an image
shows it: repeated structure would dominate otherwise (Jégou et al., On the burstiness of visual
elements, CVPR 2009). Source: Sivic & Zisserman, Video Google, ICCV 2003.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.places.recognisers import Comparison, Recognition, inverse_frequencies
from engram.places.vocabulary import Vocabulary


class BagOfWords:
    """A `PlaceRecogniser` by the cosine of tf-idf vectors. It does not detect new places.

    Args:
        vocabulary: its training images give the rarity of each word.
    """

    name = "bag-of-words"

    def __init__(self, vocabulary: Vocabulary) -> None:
        self._idf = inverse_frequencies(vocabulary.statistics)
        self._index = _core.PlaceIndex(len(vocabulary))
        self._norms = np.zeros(16)

    def __len__(self) -> int:
        return len(self._index)

    def add(self, words: NDArray[np.int32]) -> int:
        """See `PlaceRecogniser`."""
        number = self._index.add(words)
        if number == len(self._norms):
            self._norms = np.concatenate([self._norms, np.zeros(max(16, number // 8))])
        self._norms[number] = self._norm(words)
        return number

    def similarities(self, words: NDArray[np.int32]) -> NDArray[np.float64]:
        """(P,) float64: cosine, 0…1, of an image with the words (n,) int32 and each place."""
        sums = np.zeros(len(self))
        self._index.add_weights(words, self._idf[words] ** 2, sums)
        norms = self._norms[: len(self)] * self._norm(words)
        return np.divide(sums, norms, out=np.zeros_like(sums), where=norms > 0)

    def compare(self, words: NDArray[np.int32]) -> Comparison:
        """See `PlaceRecogniser`."""
        return Comparison(self.similarities(words), None)

    def recognise(self, words: NDArray[np.int32], count: int) -> Recognition:
        """See `PlaceRecogniser`."""
        cosines = self.similarities(words)
        best = _core.best_scores(cosines, count)
        return Recognition(best, cosines[best], None)

    def _norm(self, words: NDArray[np.int32]) -> float:
        return float(np.linalg.norm(self._idf[words]))
