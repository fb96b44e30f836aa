"""Cross-validation over sessions (method §8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from engram.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Fold:
    """One division of the sessions; numbers are places in the order of time.

    Attributes:
        number: 0, 1, ….
        training: sessions that the map is built from, in the order of time.
        held_out: sessions that are localised in it.
    """

    number: int
    training: tuple[int, ...]
    held_out: tuple[int, ...]


def split(sessions: int, folds: int = 5, seed: int = 0) -> tuple[Fold, ...]:
    """Every session is held out once; seeded shuffle, sizes within one. Source: method §8.

    Raises:
        ConfigError: fewer than two folds, or fewer sessions than folds.
    """
    if not 2 <= folds <= sessions:
        raise ConfigError(
            f"cannot split {sessions} sessions into {folds} folds; there must be at least 2 folds "
            "and as many sessions as folds"
        )
    shuffled = np.random.default_rng(seed).permutation(sessions)
    parts = [tuple(sorted(part.tolist())) for part in np.array_split(shuffled, folds)]
    everyone = range(sessions)
    return tuple(
        Fold(number, tuple(one for one in everyone if one not in part), part)
        for number, part in enumerate(parts)
    )


def chosen(folds: tuple[Fold, ...], only: tuple[int, ...]) -> tuple[Fold, ...]:
    """Some folds by their numbers; all where none is named."""
    return tuple(folds[number] for number in sorted(set(only))) if only else folds


def check_only(only: tuple[int, ...], folds: int) -> None:
    """Whether some requested folds exist.

    Raises:
        ConfigError: one does not.
    """
    strange = [one for one in only if not 0 <= one < folds]
    if strange:
        raise ConfigError(
            f"folds {strange} are requested; {folds} folds are numbered from 0 to {folds - 1}"
        )
