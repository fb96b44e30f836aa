"""The place recogniser protocol and its results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from engram.frontend import Frame


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """Places that an image may show: a ranking to be verified, not a localisation.

    Attributes:
        places: (K,) int64, numbers of the most likely places, best first; ties by number.
        scores: (K,) float64, their posterior probabilities; similarities, 0…1, from a recogniser
            without probabilities.
        new_place: probability that the image shows none of the places; None if unknown.
    """

    places: NDArray[np.int64]
    scores: NDArray[np.float64]
    new_place: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """How well an image fits each place.

    Attributes:
        evidence: (P,) float64, log-likelihoods relative to those of other images at the place;
            similarities, 0…1, from a recogniser without probabilities. Each is independent of the
            other places.
        new_place: see `Recognition`.
    """

    evidence: NDArray[np.float64]
    new_place: float | None


class PlaceRecogniser(Protocol):
    """Recognises places, each the set of words of one image, in other images."""

    @property
    def name(self) -> str:
        """Its key in `RECOGNISERS`."""
        ...

    def __len__(self) -> int:
        """Number of places."""
        ...

    def add(self, words: NDArray[np.int32]) -> int:
        """Adds a place.

        Args:
            words: (n,) int32, its distinct words, increasing; possibly none.

        Returns:
            Its number: 0, 1, 2, ….
        """
        ...

    def compare(self, words: NDArray[np.int32]) -> Comparison:
        """How well an image fits each place.

        Args:
            words: (n,) int32, its distinct words, increasing; possibly none.
        """
        ...

    def recognise(self, words: NDArray[np.int32], count: int) -> Recognition:
        """The up to `count` most likely places.

        Args:
            words: (n,) int32, the distinct words of the image, increasing; possibly none.
            count: most places to return.
        """
        ...


@runtime_checkable
class ReadsFrames(Protocol):
    """A `PlaceRecogniser` that compares something else of images than their words."""

    def signature(self, frame: Frame) -> NDArray[np.int32]:
        """(n,) int32: what `add`, `compare` and `recognise` take for this image instead of words.

        Raises:
            IncompatibleError: its landmarks are of another kind.
        """
        ...
