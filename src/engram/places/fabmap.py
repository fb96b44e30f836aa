"""FAB-MAP 2.0 with an inverted index: exact likelihoods at the cost of the seen words only.

log p(Z | L) is a sum over all words, most of which neither the image nor the place shows. The sum
for an image without words is computed once, when a place is added. A query corrects it for the
words that it shows and for their children in the tree, by an inverted index of the places that
show them. The result is exact.

Source: Cummins & Newman, FAB-MAP, IJRR 27(6), 2008; Appearance-only SLAM at large scale with
FAB-MAP 2.0, IJRR 30(9), 2011, §4.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.errors import ConfigError
from engram.places.observation import DetectorModel, ObservationModel
from engram.places.recogniser import Comparison, Recognition
from engram.places.vocabulary import Vocabulary


@dataclass(frozen=True, slots=True)
class FabMapConfig:
    """Settings of FAB-MAP.

    Attributes:
        detector: detection rates of the front-end.
        new_place_prior: prior probability that an image shows none of the places: a lost robot is
            as likely to be somewhere new.
        naive_bayes: treat words as independent instead of using the Chow-Liu tree.
    """

    detector: DetectorModel = field(default_factory=DetectorModel)
    new_place_prior: float = 0.5
    naive_bayes: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.new_place_prior < 1:
            raise ConfigError(
                f"fabmap: new_place_prior is {self.new_place_prior}, must be between 0 and 1"
            )


class FabMap:
    """A `PlaceRecogniser` that gives probabilities, including that of a new place.

    Args:
        vocabulary: words, their statistics, and samples of places outside the map.
        config: settings.
    """

    name = "fabmap"

    def __init__(self, vocabulary: Vocabulary, config: FabMapConfig | None = None) -> None:
        self.config = config or FabMapConfig()
        model = ObservationModel.of(
            vocabulary.statistics, self.config.detector, naive=self.config.naive_bayes
        )
        self._query = _QueryWeights(model)
        self._places = _Likelihoods(len(vocabulary), model)
        self._elsewhere = _Likelihoods(len(vocabulary), model)
        for sample in vocabulary.samples:
            self._elsewhere.add(sample)
        self._usual, self._usual_weights = self._of_samples(vocabulary)
        self._expected = np.zeros(16)

    def __len__(self) -> int:
        return len(self._places)

    @property
    def bytes_per_place(self) -> float:
        """Memory per place, without the vocabulary."""
        return (self._places.bytes + self._expected.nbytes) / max(len(self), 1)

    def add(self, words: NDArray[np.int32]) -> int:
        """See `PlaceRecogniser`."""
        number = self._places.add(words)
        if number == len(self._expected):
            self._expected = np.concatenate([self._expected, np.zeros(max(16, number // 8))])
        self._expected[number] = (
            self._places.base(number) + self._usual + self._usual_weights[words].sum()
        )
        return number

    def _of_samples(self, vocabulary: Vocabulary) -> tuple[float, NDArray[np.float64]]:
        """Mean constant, and (W,) float64 mean weight of each word, over queries by samples."""
        weights = np.zeros(len(vocabulary))
        constant = 0.0
        for sample in vocabulary.samples:
            query = self._query.weigh(sample)
            weights[query.words] += query.weights
            constant += query.constant
        count = max(len(vocabulary.samples), 1)
        return constant / count, weights / count

    def log_likelihoods(self, words: NDArray[np.int32]) -> NDArray[np.float64]:
        """(P,) float64: log p(Z | L) of an image with the words (n,) int32 at each place."""
        return self._places.of(self._query.weigh(words))

    def compare(self, words: NDArray[np.int32]) -> Comparison:
        """See `PlaceRecogniser`: the log-likelihood at each place less its mean over the samples.

        In a map of several conditions the likelihoods alone mislead: places seen in dull light
        exceed all others by tens of nats for any image. The mean over images of other places
        corrects for this.
        """
        scores, elsewhere = self._judge(words)
        if len(scores) == 0:
            return Comparison(scores, 1.0)
        evidence = self._evidence(scores, elsewhere)
        return Comparison(
            scores - self._expected[: len(self)],
            float(np.exp(self._prior_elsewhere + elsewhere - evidence)),
        )

    def recognise(self, words: NDArray[np.int32], count: int) -> Recognition:
        """See `PlaceRecogniser`. All places have the same prior."""
        scores, elsewhere = self._judge(words)
        if len(scores) == 0:
            return Recognition(np.zeros(0, np.int64), np.zeros(0), 1.0)
        evidence = self._evidence(scores, elsewhere)
        best = _core.best_scores(scores, count)
        return Recognition(
            best,
            np.exp(scores[best] + self._prior_here - evidence),
            float(np.exp(elsewhere + self._prior_elsewhere - evidence)),
        )

    @property
    def _prior_elsewhere(self) -> float:
        return float(np.log(self.config.new_place_prior))

    @property
    def _prior_here(self) -> float:
        """Log prior of each place."""
        return float(np.log((1 - self.config.new_place_prior) / len(self)))

    def _judge(self, words: NDArray[np.int32]) -> tuple[NDArray[np.float64], float]:
        """(P,) float64 log-likelihood at each place, and that elsewhere."""
        weights = self._query.weigh(words)
        sampled = self._elsewhere.of(weights)
        return self._places.of(weights), _log_mean(sampled)

    def _evidence(self, scores: NDArray[np.float64], elsewhere: float) -> float:
        """Log of the sum of prior times likelihood, over all places and elsewhere."""
        greatest = float(scores.max())
        # Terms below e^-40 of the greatest vanish in the rounding of the sum.
        near = scores[scores > greatest - 40.0]
        here = self._prior_here + greatest + float(np.log(np.exp(near - greatest).sum()))
        return float(np.logaddexp(here, self._prior_elsewhere + elsewhere))


def _log_mean(logs: NDArray[np.float64]) -> float:
    """Log of the mean of exp; −∞ for an empty array."""
    if len(logs) == 0:
        return -np.inf
    greatest = float(logs.max())
    return greatest + float(np.log(np.exp(logs - greatest).mean()))


@dataclass(frozen=True, slots=True, eq=False)
class _Weighed:
    """A query, relative to an image without words.

    Attributes:
        constant: log-likelihood of the image at a place without words.
        words: (n,) int32, words seen and their children.
        weights: (n,) float64, change of a place's log-likelihood if it shows the word.
    """

    constant: float
    words: NDArray[np.int32]
    weights: NDArray[np.float64]


class _QueryWeights:
    """Turns the words of a query into weights of words."""

    def __init__(self, model: ObservationModel) -> None:
        unseen, seen = model.log_p
        gain = seen - unseen
        self._has_parent = model.parents >= 0
        self._parents = np.maximum(model.parents, 0)
        self._weight = gain - gain[0]
        self._empty = unseen - unseen[0]
        self._nothing = float(unseen[0].sum())

    def weigh(self, words: NDArray[np.int32]) -> _Weighed:
        z = np.zeros(len(self._parents), np.int8)
        z[words] = 2
        case = z + ((z[self._parents] > 0) & self._has_parent)
        touched = np.flatnonzero(case).astype(np.int32)
        case = case[touched]
        constant = self._nothing + float(self._empty[case, touched].sum())
        return _Weighed(constant, touched, self._weight[case, touched])


class _Likelihoods:
    """Places, and the log-likelihood of a query at each."""

    def __init__(self, words: int, model: ObservationModel) -> None:
        self._index = _core.PlaceIndex(words)
        self._gain_unseen = model.log_p[1, 0] - model.log_p[0, 0]
        self._base = np.zeros(16)

    def __len__(self) -> int:
        return len(self._index)

    @property
    def bytes(self) -> int:
        return self._index.bytes + self._base.nbytes

    def add(self, words: NDArray[np.int32]) -> int:
        number = self._index.add(words)
        if number == len(self._base):
            self._base = np.concatenate([self._base, np.zeros(max(16, number // 8))])
        self._base[number] = self._gain_unseen[words].sum()
        return number

    def base(self, number: int) -> float:
        """Log-likelihood of an image without words at a place."""
        return float(self._base[number])

    def of(self, query: _Weighed) -> NDArray[np.float64]:
        """(P,) float64."""
        sums = self._base[: len(self)] + query.constant
        self._index.add_weights(query.words, query.weights, sums)
        return sums
