"""Training a vocabulary from the descriptors of many frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.errors import InputError
from engram.frontend import DescriptorKind
from engram.monitor import QUIET, Monitor
from engram.places.chow_liu import learn_statistics
from engram.places.tree import grow_tree
from engram.places.vocabulary import Vocabulary


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """Settings of `train_vocabulary`.

    Attributes:
        words: number of words.
        depth: levels of the tree. Three find the nearest word more often than four, and as fast.
        beam: see `Vocabulary`.
        iterations: most iterations per cluster; more have no measurable effect.
        descriptors: most descriptors to cluster, drawn evenly from all frames.
        samples: frames that represent new places. Source: Cummins & Newman, IJRR 2008, §4.5:
            sampling estimates the sum over unmapped places.
        seed: seed of all random draws.
    """

    words: Annotated[int, Meta(ge=2, le=65_536)] = 10_000
    depth: Annotated[int, Meta(ge=1, le=6)] = 3
    beam: Annotated[int, Meta(ge=1, le=8)] = 2
    iterations: Annotated[int, Meta(ge=1, le=1000)] = 10
    descriptors: Annotated[int, Meta(ge=2, le=100_000_000)] = 1_000_000
    samples: Annotated[int, Meta(ge=1, le=10_000)] = 100
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 0

    def __post_init__(self) -> None:
        check_bounds(self)


def train_vocabulary(
    frames: Sequence[NDArray[np.uint8]],
    kind: DescriptorKind,
    config: TrainingConfig | None = None,
    *,
    trained_on: str = "",
    monitor: Monitor = QUIET,
) -> Vocabulary:
    """Clusters descriptors into words and learns which words occur together.

    Equal input and configuration give an equal vocabulary on every machine.

    Args:
        frames: the descriptors of each frame, (N, B) uint8. The frames should show distinct
            places, like a random sample of where robots drive, as words are counted per frame.
        kind: kind of the descriptors.
        config: settings.
        trained_on: description stored in the vocabulary, for people.
        monitor: receives the stages `cluster`, `quantise` and `relate`.

    Raises:
        InputError: fewer descriptors than words.
    """
    config = config or TrainingConfig()
    total = sum(len(frame) for frame in frames)
    if total < config.words:
        raise InputError(
            f"{len(frames)} frames have {total} descriptors, too few for {config.words} words; "
            "give more drives or fewer words"
        )
    rng = np.random.default_rng(config.seed)
    rows = np.concatenate(frames)
    if total > config.descriptors:
        rows = rows[np.sort(rng.choice(total, config.descriptors, replace=False))]
    tree = grow_tree(
        rows,
        config.words,
        config.depth,
        iterations=config.iterations,
        seed=config.seed,
        monitor=monitor,
    )
    search = tree.searchable()
    images = []
    with monitor.stage("quantise", len(frames)) as stage:
        for frame in frames:
            images.append(np.unique(search.quantise(frame, config.beam)))
            stage.advance()
    statistics = learn_statistics(images, tree.words, monitor)
    usable = [at for at, image in enumerate(images) if len(image)]
    drawn = rng.choice(usable, min(config.samples, len(usable)), replace=False)
    samples = tuple(images[at] for at in np.sort(drawn))
    return Vocabulary(kind, tree, statistics, samples, config.beam, trained_on)
