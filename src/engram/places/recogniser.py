"""What a place recogniser takes and answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """Which places an image may show. A ranking to be verified, never a localisation.

    Attributes:
        places: (K,) int64, numbers of the most likely places, best first; ties by number.
        scores: (K,) float64 of these: posterior probabilities, or similarities of 0…1 where the
            recogniser knows no probabilities.
        new_place: probability that the image shows none of the places; None where the recogniser
            cannot tell.
    """

    places: NDArray[np.int64]
    scores: NDArray[np.float64]
    new_place: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """How well an image fits each place.

    Attributes:
        evidence: (P,) float64, log-likelihoods beyond what the place gives to any image, or
            similarities of 0…1 where the recogniser knows no probabilities. What one place is
            given does not depend on the others.
        new_place: see `Recognition`.
    """

    evidence: NDArray[np.float64]
    new_place: float | None


class PlaceRecogniser(Protocol):
    """Places, each an image's set of words, and which of them another image may show."""

    @property
    def name(self) -> str:
        """Its key in `RECOGNISERS`."""
        ...

    def __len__(self) -> int:
        """Number of places."""
        ...

    def add(self, words: NDArray[np.int32]) -> int:
        """Adds a place, which can be recognised at once.

        Args:
            words: (n,) the distinct words that it shows, rising; possibly none.

        Returns:
            Its number: 0, 1, 2, ….
        """
        ...

    def compare(self, words: NDArray[np.int32]) -> Comparison:
        """How well an image fits each place.

        Args:
            words: (n,) the distinct words of the image, rising; possibly none.
        """
        ...

    def recognise(self, words: NDArray[np.int32], count: int) -> Recognition:
        """The up to `count` most likely places.

        Args:
            words: (n,) the distinct words of the image, rising; possibly none.
            count: how many places are wanted at most.
        """
        ...
