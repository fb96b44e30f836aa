"""FAB-MAP's observation model: the likelihood of seeing or missing a word at a place.

Source: Cummins & Newman, FAB-MAP, IJRR 27(6), 2008, §4.2 to §4.4 (here [C08]); Appearance-only SLAM
at large scale with FAB-MAP 2.0, IJRR 30(9), 2011 (here [C11]).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError
from engram.places.chow_liu import WordStatistics

# Bound of beliefs away from 0 and 1: a word without training data must not decide.
_LEAST_BELIEF = 1e-6
_MOST_BELIEF = 1 - 1e-3


@dataclass(frozen=True, slots=True)
class DetectorModel:
    """Detection rates of the front-end.

    Attributes:
        hit: p(z = 1 | e = 1), probability of seeing a word that exists. Source: [C08] §5.
        false_alarm: p(z = 1 | e = 0), probability of seeing one that does not. Source: [C08] §5.
    """

    hit: float = 0.39
    false_alarm: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.false_alarm < self.hit < 1:
            raise ConfigError(
                f"detector: needs 0 <= false_alarm < hit < 1, not {self.false_alarm} and {self.hit}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class ObservationModel:
    """log p(z_q | z_parent, place) for all words and all cases.

    Attributes:
        parents: (W,) int32, -1 for a root, which has equal columns for both values of z_parent.
        log_p: (2, 4, W) float64, log-probabilities: [whether the place shows the word][2 z +
            z_parent].
    """

    parents: NDArray[np.int32]
    log_p: NDArray[np.float64]

    @staticmethod
    def of(
        statistics: WordStatistics, detector: DetectorModel, *, naive: bool = False
    ) -> ObservationModel:
        """The model of a vocabulary.

        Args:
            statistics: statistics of the vocabulary.
            detector: detection rates of the front-end.
            naive: treat words as independent (naive Bayes).
        """
        parents = np.full_like(statistics.parents, -1) if naive else statistics.parents
        p_seen, p_given_parent = _probabilities(statistics)
        sight = np.array(  # [e][z]
            [
                [1 - detector.false_alarm, detector.false_alarm],
                [1 - detector.hit, detector.hit],
            ]
        )
        belief = place_beliefs(p_seen, detector)
        log_p = np.empty((2, 4, len(parents)))
        for shown in (0, 1):
            for z in (0, 1):
                for z_parent in (0, 1):
                    given = [
                        _given_existence(p_seen, p_given_parent[z_parent], sight[e], z, parents)
                        for e in (0, 1)
                    ]
                    there = belief[shown]
                    mixed = given[1] * there + given[0] * (1 - there)
                    log_p[shown, 2 * z + z_parent] = np.log(mixed)
        return ObservationModel(parents, log_p)


def place_beliefs(p_seen: NDArray[np.float64], detector: DetectorModel) -> NDArray[np.float64]:
    """(2, W) float64: p(e_q = 1 | place), row 0 for places not showing the word, row 1 for others.

    Bayes' rule for one image of the place. The prior is the share of places with the word that
    explains how often it is seen.

    Args:
        p_seen: (W,) float64, probability p(z_q = 1).
        detector: detection rates of the front-end.

    Source: [C08] §4.4.
    """
    span = detector.hit - detector.false_alarm
    prior = np.clip((p_seen - detector.false_alarm) / span, _LEAST_BELIEF, _MOST_BELIEF)
    beliefs = []
    for there, absent in (
        (1 - detector.hit, 1 - detector.false_alarm),
        (detector.hit, detector.false_alarm),
    ):
        beliefs.append(there * prior / (there * prior + absent * (1 - prior)))
    return np.clip(np.stack(beliefs), _LEAST_BELIEF, _MOST_BELIEF)


def _probabilities(
    statistics: WordStatistics,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """p(z_q = 1), (W,), and p(z_q = 1 | z_parent), (2, W); equal for a root.

    Smoothed by half an image with and half an image without the word; the conditional ones by one
    image with the unconditional probability.
    """
    images, seen = statistics.images, statistics.seen
    p_seen = (seen + 0.5) / (images + 1)
    parents = statistics.parents
    parent_seen = np.where(parents >= 0, seen[parents], 0)
    both = statistics.seen_with_parent
    without = (seen - both + p_seen) / (images - parent_seen + 1)
    together = (both + p_seen) / (parent_seen + 1)
    given = np.stack([without, together])
    return p_seen, np.where(parents >= 0, given, p_seen)


def _given_existence(
    p_seen: NDArray[np.float64],
    p_given_parent: NDArray[np.float64],
    sight: NDArray[np.float64],
    z: int,
    parents: NDArray[np.int32],
) -> NDArray[np.float64]:
    """(W,) float64: p(z_q | e_q, z_parent) = (1 + α/β)⁻¹.

    Args:
        p_seen: (W,) float64, probability p(z_q = 1).
        p_given_parent: (W,) float64, p(z_q = 1 | z_parent).
        sight: (2,) float64, p(z = 0 | e) and p(z = 1 | e) for the given existence e.
        z: whether the word is seen.
        parents: (W,) int32; for roots, -1, only the detector counts.

    Source: [C08] §4.3.
    """
    p_z = p_seen if z else 1 - p_seen
    p_z_given_parent = p_given_parent if z else 1 - p_given_parent
    alpha = p_z * sight[1 - z] * (1 - p_z_given_parent)
    beta = (1 - p_z) * sight[z] * p_z_given_parent
    given: NDArray[np.float64] = np.where(parents >= 0, beta / (alpha + beta), sight[z])
    return given
