"""Made-up vocabularies and images for the tests of place recognition."""

from __future__ import annotations

import numpy as np

from engram.frontend.frame import BRIEF
from engram.places.vocabulary import TrainingConfig, Vocabulary, train_vocabulary

THINGS = 60


def appearances(seed: int = 0) -> np.ndarray:
    """(THINGS, 32) uint8: what things look like."""
    return np.random.default_rng(seed).integers(0, 256, (THINGS, 32), dtype=np.uint8)


def look(things: np.ndarray, rng: np.random.Generator, flip: float = 0.04) -> np.ndarray:
    """Descriptors of some things, with bits flipped by noise."""
    shown = appearances()[things]
    return shown ^ np.packbits(rng.random((len(shown), 256)) < flip, axis=1)


def places(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Things of each place: pairs 2k, 2k + 1 mostly come together."""
    pairs = rng.random((count, THINGS // 2)) < 0.35
    both = np.repeat(pairs, 2, axis=1) ^ (rng.random((count, THINGS)) < 0.05)
    return [np.flatnonzero(row) for row in both]


def small_vocabulary(seed: int = 0) -> Vocabulary:
    rng = np.random.default_rng(seed)
    frames = [look(things, rng) for things in places(150, rng)]
    config = TrainingConfig(words=THINGS, depth=2, samples=20, seed=seed)
    return train_vocabulary(frames, BRIEF, config)
