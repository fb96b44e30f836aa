"""What a question of the faults study is asked with, and its table, kept as it grows."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from engram.config import config_hash
from engram.localiser.settings import METHOD_VERSION
from engram.robot.settings import Settings
from engram_lab.accuracy import Count
from engram_lab.intervals import Array, Resamples
from engram_lab.programs import Figure
from engram_lab.studies.streets import HELD_OUT_TOWNS

_LEVEL = 0.95


@dataclass(frozen=True, slots=True)
class Asked:
    """What a question is asked of; empty or None: its own choice.

    Attributes:
        settings: of robots; maps are built with the default `localiser` and `gaps`.
        folder: where its table is kept.
        towns: seeds of trial towns.
        campaign: NAME, NAME@SEED, or the seed of a longer trial town.
        mapped, live: numbers of the drives that are mapped, and localised.
        trials: how much: robots, starts, maps or drives.
    """

    settings: Settings
    folder: Path
    towns: tuple[int, ...] = HELD_OUT_TOWNS
    campaign: str = ""
    mapped: tuple[int, ...] = ()
    live: tuple[int, ...] = ()
    trials: int | None = None


class Table:
    """Counts of robots by row, a line of JSON for each; what the file holds is not made again."""

    def __init__(self, name: str, asked: Asked) -> None:
        asked.folder.mkdir(parents=True, exist_ok=True)
        made_by = config_hash(asked.settings)[:8]
        self._path = asked.folder / f"{name}-{METHOD_VERSION}-{made_by}.jsonl"
        lines = self._path.read_text(encoding="utf-8").splitlines() if self._path.exists() else []
        kept = [json.loads(line) for line in lines if line.endswith("}")]
        self._kept = {
            one["key"]: Count(**{**one["count"], "again": tuple(one["count"]["again"])})
            for one in kept
        }
        self._rows: dict[str, Count] = {}

    def add(self, row: str, key: str, make: Callable[[], Count]) -> Count:
        """Adds robots to a row; `key` is unique in the row."""
        key = f"{row}: {key}"
        if key not in self._kept:
            self._kept[key] = make()
            line = json.dumps({"key": key, "count": asdict(self._kept[key])})
            with self._path.open("a", encoding="utf-8") as out:
                out.write(f"{line}\n")
        self._rows[row] = self._rows.get(row, Count()) + self._kept[key]
        return self._kept[key]

    def figures(self) -> Iterator[Figure]:
        """Every row, then all together."""
        for name, one in (*self._rows.items(), ("all", sum(self._rows.values(), Count()))):
            yield from figures_of(name, one)


def figures_of(name: str, one: Count) -> Iterator[Figure]:
    """A count; the bound on false events is Poisson's."""
    yield Figure(f"{name}: robots", one.robots)
    yield Figure("  driven", one.metres / 1000, "km")
    yield Figure("  right fixes", 100 * one.right / max(one.frames, 1), "% of frames")
    yield Figure("  more than 0.5 m off", one.off, "fixes")
    yield Figure("  false", one.false, "fixes")
    yield Figure("  false with confidence above 7", one.sure, "fixes")
    yield Figure("  robots with false fixes", one.hurt)
    yield Figure("  false events", one.events)
    if one.metres:
        bound = float(chi2.ppf(_LEVEL, 2 * (one.events + 1)) / 2)
        yield Figure("  their upper bound, 95 %", 1e5 * bound / one.metres, "per 100 km")
    yield Figure("  largest error of a fix", one.worst_m, "m")
    yield Figure("  found again", 100 * len(one.again) / max(one.robots, 1), "% of robots")
    if one.again:
        yield Figure("  after (median)", float(np.median(one.again)), "frames")
        yield Figure("  after (worst)", max(one.again), "frames")


def paired(name: str, before: Sequence[float], after: Sequence[float]) -> Iterator[Figure]:
    """Shares of routes that the same drives miss by two ways, and the difference with its 90 %."""
    a, b = np.array(before), np.array(after)

    def more(weights: Array) -> Array:
        return np.asarray(weights @ (b - a) / len(a))

    found = Resamples.of(len(a)).interval(more)
    yield Figure(f"{name}: missed", 100 * float(a.mean()), "%")
    yield Figure("  instead", 100 * float(b.mean()), "%")
    for what, value in (("more", found.estimate), ("from", found.low), ("to", found.high)):
        yield Figure(f"  {what}", 100 * value, "points")
