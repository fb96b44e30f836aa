"""Place recognition on made-up words, and the training of a vocabulary."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import BRIEF
from engram.places.recognisers import FabMap
from engram.places.vocabulary import (
    TrainingConfig,
    TreeArrays,
    Vocabulary,
    WordStatistics,
    train_vocabulary,
)
from engram_lab.bench.data import BenchData
from engram_lab.bench.plain import PlainPipeline
from engram_lab.bench.stage import Prepared
from engram_lab.dense import DenseTable

_BRANCHES = (22, 22, 22)  # 10,648 leaves, of which the last level keeps 10,000
_WORDS = 10_000
_SHOWN = 470  # words that an image of 500 to 600 landmarks shows on average, of 10,000
_QUERIES = 16
_LOOKS = 5000  # drawing a million would take a minute
_LANDMARKS = 500
_TRAINING_FRAMES, _TRAINING_WORDS = 100, 1000


def prepare_places_query(
    data: BenchData, plain: PlainPipeline | None, *, places: int, dense: bool
) -> Prepared:
    """500 descriptors in, the ten most likely of `places` places out, by FAB-MAP at 10,000 words.

    Words are as frequent as a gamma distribution makes them, some in every second image and most
    in few; there are 5,000 looks that places can have. The reference is `DenseTable`; it gets its
    words from the same tree.
    """
    del data, plain
    rng = np.random.default_rng(places)
    vocabulary = made_up_vocabulary(rng)
    frequency = vocabulary.statistics.seen / vocabulary.statistics.images
    recogniser = FabMap(vocabulary)
    table = DenseTable(vocabulary, recogniser.config, places) if dense else None
    looks = [_drawn(frequency, rng) for _ in range(min(places, _LOOKS))]
    for look in rng.integers(0, len(looks), places):
        recogniser.add(looks[look])
        if table is not None:
            table.add(looks[look])
    leaves = vocabulary.tree.leaf_centres
    queries = [leaves[rng.choice(_drawn(frequency, rng), _LANDMARKS)] for _ in range(_QUERIES)]

    def words_of(i: int) -> NDArray[np.int32]:
        return vocabulary.words_of(queries[i % _QUERIES], BRIEF)

    def ours(i: int) -> dict[str, int]:
        words = words_of(i)
        recogniser.recognise(words, 10)
        memory = round(recogniser.bytes_per_place)
        return {"places": places, "words": len(words), "bytes_per_place": memory}

    if table is None:
        return Prepared(ours)

    def reference(i: int) -> dict[str, int]:
        words = words_of(i)
        table.best(words, 10)
        return {"places": places, "words": len(words), "bytes_per_place": 4 * _WORDS}

    return Prepared(ours, reference)


def prepare_vocabulary_train(data: BenchData, plain: PlainPipeline | None) -> Prepared:
    """1,000 words and their Chow-Liu tree from 100 frames of 500 descriptors.

    A hundredth of what `engram vocabulary train` is made for: clustering costs in proportion to
    descriptors, the tree of words in proportion to the square of the words. There is no reference.
    """
    del data, plain
    rng = np.random.default_rng(0)
    things = rng.integers(0, 256, (2000, 32), dtype=np.uint8)
    frames = []
    for _ in range(_TRAINING_FRAMES):
        seen = things[rng.integers(0, len(things), _LANDMARKS)]
        frames.append(seen ^ np.packbits(rng.random((_LANDMARKS, 256)) < 0.08, axis=1))
    config = TrainingConfig(words=_TRAINING_WORDS)

    def ours(_: int) -> dict[str, int]:
        vocabulary = train_vocabulary(frames, BRIEF, config)
        return {"words": len(vocabulary), "descriptors": _TRAINING_FRAMES * _LANDMARKS}

    return Prepared(ours)


def made_up_vocabulary(rng: np.random.Generator) -> Vocabulary:
    """10,000 words in a tree of three levels, and a tree of company of random shape."""
    images = 2000
    share = rng.gamma(0.8, size=_WORDS)
    frequency = np.minimum(_SHOWN * share / share.sum(), 0.9)
    seen = (images * frequency).astype(np.int32)
    before = np.arange(_WORDS)
    parents = np.where(before > 0, rng.integers(0, np.maximum(before, 1)), -1).astype(np.int32)
    both = np.where(parents >= 0, np.minimum(seen, seen[parents]) // 2, 0).astype(np.int32)
    statistics = WordStatistics(images, seen, parents, both)
    samples = tuple(_drawn(frequency, rng) for _ in range(100))
    return Vocabulary(BRIEF, _made_up_tree(rng), statistics, samples)


def _made_up_tree(rng: np.random.Generator) -> TreeArrays:
    """Centres that differ from their parents in fewer bits the deeper they are."""
    level = np.zeros((1, 32), np.uint8)
    levels, children = [level], []
    for branches, flips in zip(_BRANCHES, (0.5, 0.2, 0.1), strict=True):
        count = len(level) * branches
        counts = np.full(len(level), branches)
        if count > _WORDS:
            counts = np.diff(np.linspace(0, _WORDS, len(level) + 1).astype(np.int64))
            count = _WORDS
        level = np.repeat(level, counts, axis=0)
        level = level ^ np.packbits(rng.random((count, 256)) < flips, axis=1)
        levels.append(level)
        children.append(counts)
    children.append(np.zeros(len(level), np.int64))
    bounds = np.concatenate([[1], 1 + np.cumsum(np.concatenate(children))])
    return TreeArrays(np.concatenate(levels), bounds.astype(np.int32))


def _drawn(frequency: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.int32]:
    """Words of an image, each drawn by itself."""
    return np.flatnonzero(rng.random(len(frequency), np.float32) < frequency).astype(np.int32)
