"""What is run: policies under budgets and settings, and the sweeps of [L15]'s figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from enum import StrEnum
from typing import Any

from engram.localiser.localisation import Budget
from engram.localiser.settings import LocaliserConfig, PathEntries

# Lanes of a budget that never runs out.
UNLIMITED = 1_000_000
DEFAULT_LANES = (1, 2, 3, 4, 6, 8, 12, 16, UNLIMITED)
# Source: [L15] Fig. 13.
T_SWEEP = (0, 1, 2, 5, 10, 20, 50, 100, 200)
# The budget of [L15]'s Figs. 9, 12 and 13.
FEW_LANES = 2
# Policies whose second round is measured too.
TWO_ROUNDS = ("distance", "path-near", "recall")
PATH_POLICIES = ("path-near", "path")
# A relocaliser that finds whatever matches. Without any, the choice at which a drive loses itself
# decides the rest of it.
BY_TRUTH = "truth"


class Radius(StrEnum):
    """How far candidates are searched for."""

    SEARCH = "search"  # max(8 m, basin + 2σ), method §3.1
    BASIN = "basin"  # basin + 2σ: our other reading of "local metric neighbourhood"


class PathKinds(StrEnum):
    """Which entries put a node on a path."""

    ALL = "matched+saved"
    MATCHED = "matched"  # [L15 §IV]'s text

    @property
    def entries(self) -> PathEntries:
        """The setting that says so."""
        return PathEntries.ALL if self is PathKinds.ALL else PathEntries.MATCHES

    @property
    def other(self) -> PathKinds:
        """What the study varies it to."""
        return PathKinds.MATCHED if self is PathKinds.ALL else PathKinds.ALL

    @staticmethod
    def of(config: LocaliserConfig) -> PathKinds:
        """As the settings have it."""
        return next(one for one in PathKinds if one.entries is config.path_entries)


@dataclass(frozen=True, slots=True)
class Configuration:
    """One way to localise the held-out sessions; what it leaves out, the settings give.

    Attributes:
        T: iterations remembered; None for those of the settings.
        paths: which entries count in path memory; None for those of the settings.
        sessions: in the map after so many training sessions; None for all of them.
    """

    policy: str
    lanes: int = FEW_LANES
    rounds: int = 1
    T: int | None = None
    radius: Radius = Radius.SEARCH
    paths: PathKinds | None = None
    sessions: int | None = None

    @property
    def is_plain(self) -> bool:
        """Whether all but policy and budget are as in the settings."""
        varies = self.T is not None or self.paths is not None
        return not varies and self.radius is Radius.SEARCH

    @property
    def budget(self) -> Budget:
        """Np × Nr."""
        return Budget(self.lanes, self.rounds)

    @property
    def lanes_text(self) -> str:
        """Np for tables."""
        return lanes_text(self.lanes)

    @property
    def label(self) -> str:
        """The policy and what is unusual about it, for tables and legends."""
        parts = [self.policy]
        if self.radius is Radius.BASIN:
            parts.append("radius = basin")
        if self.paths is not None:
            parts.append("matched only" if self.paths is PathKinds.MATCHED else "saved, too")
        return ", ".join(parts)

    def settings_over(self, config: LocaliserConfig) -> LocaliserConfig:
        """The settings, changed as far as the configuration says otherwise."""
        if self.T is not None:
            config = replace(config, recent=replace(config.recent, T=self.T))
        if self.paths is not None:
            config = replace(config, path_entries=self.paths.entries)
        return replace(config, search_radius_m=0.0) if self.radius is Radius.BASIN else config

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Configuration:
        """The reverse of `to_dict`."""
        known = {one.name for one in fields(Configuration)}
        plain = {name: value for name, value in values.items() if name in known}
        paths = values["paths"]
        typed = {
            "radius": Radius(values["radius"]),
            "paths": None if paths is None else PathKinds(paths),
        }
        return Configuration(**{**plain, **typed})


# Attempts every candidate: shows what could have succeeded ([L15] Fig. 10) and whom the
# neighbourhood overlooks.
EVERYTHING = Configuration("distance", UNLIMITED)


def sweep(
    policies: Sequence[str],
    lanes: Sequence[int] = DEFAULT_LANES,
    rounds: Sequence[int] = (1, 2),
    config: LocaliserConfig | None = None,
) -> tuple[Configuration, ...]:
    """All that is run in the whole map: policy × Np, T, Nr = 2, and the path policies' variants.

    Args:
        config: the settings, from which the variants differ; None for the defaults.
    """
    config = config or LocaliserConfig()
    other = PathKinds.of(config).other
    found: dict[Configuration, None] = {}

    def add(some: Iterable[Configuration]) -> None:
        found.update(dict.fromkeys(some))

    few = FEW_LANES if FEW_LANES in lanes else lanes[0]
    for policy in policies:
        add(Configuration(policy, np, rounds[0]) for np in lanes)
    if UNLIMITED in lanes or "oracle" in policies:
        add([EVERYTHING])  # every match is made anyway, which is most of the time all this takes
    for nr in rounds[1:]:
        limited = [np for np in lanes if np != UNLIMITED]
        add(Configuration(one, np, nr) for one in policies if one in TWO_ROUNDS for np in limited)
    if "path-near" in policies:
        add(Configuration("path-near", np, rounds[0], paths=other) for np in lanes)
    for policy in PATH_POLICIES:
        if policy in policies:
            swept = (None if T == config.recent.T else T for T in T_SWEEP)
            add(Configuration(policy, few, rounds[0], T) for T in swept)
            add([Configuration(policy, few, rounds[0], radius=Radius.BASIN)])
            add([Configuration(policy, few, rounds[0], paths=other)])
    return tuple(found)


def map_sizes(
    policies: Sequence[str], lanes: int, sessions: int, rounds: int = 1
) -> tuple[Configuration, ...]:
    """[L15] Fig. 9: each policy in the map after 1, 2, 4 training sessions and every eighth."""
    counts = (1, 2, 4, *range(8, sessions, 8))
    return tuple(
        Configuration(policy, lanes, rounds, sessions=count)
        for count in counts
        if count < sessions
        for policy in policies
    )


def lanes_text(lanes: int) -> str:
    """Np for people."""
    return "unlimited" if lanes == UNLIMITED else str(lanes)
