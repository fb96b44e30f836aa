"""Training a vocabulary from the descriptors of many frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError, InputError
from engram.frontend import DescriptorKind
from engram.places.chow_liu import learn_statistics
from engram.places.tree import grow_tree
from engram.places.vocabulary import Vocabulary

Advance = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """How a vocabulary is trained.

    Attributes:
        words: how many are wanted.
        depth: levels of the tree. Three find the nearest word more often than four, and as fast.
        beam: see `Vocabulary`.
        iterations: at most so many of each cluster; more changed nothing that could be measured.
        descriptors: at most so many are clustered, drawn evenly from all frames.
        samples: frames that stand for new places. Source: Cummins & Newman, IJRR 2008, §4.5: the
            sum over unmapped places is estimated by sampling.
        seed: of all that is drawn.
    """

    words: int = 10_000
    depth: int = 3
    beam: int = 2
    iterations: int = 10
    descriptors: int = 1_000_000
    samples: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        limits = {
            "words": (2, 65_536),
            "depth": (1, 6),
            "beam": (1, 8),
            "iterations": (1, 1000),
            "descriptors": (2, 100_000_000),
            "samples": (1, 10_000),
            "seed": (0, 2**31 - 1),
        }
        for name, (least, most) in limits.items():
            if not least <= getattr(self, name) <= most:
                raise ConfigError(
                    f"vocabulary: {name} is {getattr(self, name)}, must be {least} to {most}"
                )


def train_vocabulary(
    frames: Sequence[NDArray[np.uint8]],
    kind: DescriptorKind,
    config: TrainingConfig | None = None,
    *,
    trained_on: str = "",
    advance: Advance | None = None,
) -> Vocabulary:
    """Clusters descriptors to words and learns which words come together.

    Equal input and configuration give an equal vocabulary on every machine.

    Args:
        frames: the descriptors (N, B) uint8 of each frame. Frames should show places apart from
            each other, as if drawn at random from where robots drive: words are counted per frame.
        kind: their kind.
        config: settings.
        trained_on: kept in the vocabulary, for people.
        advance: called now and then with what is done and the share of it, 0…1.

    Raises:
        InputError: fewer descriptors than words.
    """
    config = config or TrainingConfig()
    advance = advance or _ignore
    total = sum(len(frame) for frame in frames)
    if total < config.words:
        raise InputError(
            f"{len(frames)} frames have {total} descriptors, too few for {config.words} words; "
            "give more drives, or ask for fewer words"
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
        advance=lambda share: advance("cluster", share),
    )
    search = tree.searchable()
    images = []
    for at, frame in enumerate(frames):
        images.append(np.unique(search.quantise(frame, config.beam)))
        advance("quantise", (at + 1) / len(frames))
    statistics = learn_statistics(images, tree.words, lambda share: advance("relate", share))
    usable = [at for at, image in enumerate(images) if len(image)]
    drawn = rng.choice(usable, min(config.samples, len(usable)), replace=False)
    samples = tuple(images[at] for at in np.sort(drawn))
    return Vocabulary(kind, tree, statistics, samples, config.beam, trained_on)


def _ignore(what: str, share: float) -> None:
    """For callers that do not want to know."""
    del what, share
