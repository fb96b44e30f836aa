"""Settings of the localiser."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from typing import Annotated

import numpy as np
from msgspec import Meta

from engram.config import PUBLIC, check_bounds
from engram.errors import ConfigError
from engram.frontend.matching import MatcherConfig
from engram.graph.basin import BasinConfig
from engram.graph.model import PathEntryKind
from engram.graph.paths import ALL_KINDS, MATCHES_ONLY
from engram.localiser.acceptance import AcceptanceConfig
from engram.localiser.yardstick import LookalikeConfig
from engram.ranking.lessons import LessonsConfig
from engram.ranking.recent import RecentConfig

# Raise it when equal settings give different results: stored studies of another version are not
# continued.
METHOD_VERSION = 27


class NeighbourhoodSearch(StrEnum):
    """How the candidates near the robot are found."""

    SUREST = "surest"
    BREADTH_FIRST = "breadth-first"


class PathEntries(StrEnum):
    """Which nodes are on a path when a policy counts paths."""

    ALL = "all"
    MATCHES = "matches"

    @property
    def kinds(self) -> frozenset[PathEntryKind]:
        """The kinds of entry that count."""
        return MATCHES_ONLY if self is PathEntries.MATCHES else ALL_KINDS

    @staticmethod
    def of(kinds: Collection[PathEntryKind]) -> PathEntries:
        """The setting by which these kinds count."""
        return PathEntries.MATCHES if frozenset(kinds) == MATCHES_ONLY else PathEntries.ALL


class Success(StrEnum):
    """Which success of a round is the localisation."""

    MOST_INLIERS = "most-inliers"
    FIRST = "first"


@dataclass(frozen=True, slots=True)
class HypothesesConfig:
    """How long weak matches of a lost robot wait for others that agree."""

    base_line_m: Annotated[
        float,
        Meta(
            ge=0,
            description="distance between two matches, m, from which one false cause no longer "
            "explains both",
        ),
    ] = 4.0
    long_base_line_m: Annotated[
        float,
        Meta(
            ge=0,
            description="the same, by agreeing matches, once a robot has found nothing for "
            "`acceptance.lost_long_m`: streets look alike over tens of metres",
        ),
    ] = 30.0
    forgotten_after_m: Annotated[
        float,
        Meta(
            gt=0,
            description="m driven after which a weak match is dropped: its scene is out of sight, "
            "and odometry has drifted",
        ),
    ] = 15.0
    most: Annotated[
        int, Meta(ge=1, description="most weak matches kept; the oldest is dropped")
    ] = 8

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True)
class LocaliserConfig:
    """Settings of the localiser.

    Attributes:
        search_radius_m: least radius of the neighbourhood. Source: method §3.
        max_search_radius_m: largest radius of the neighbourhood, unless the match basin is wider.
            Beyond it the relocaliser finds the robot.
        view_gate_rad: largest difference of heading to a candidate. Source: method §3.
        own_exclusion_m: own nodes saved within this last distance are not candidates. Source:
            method §3.1.
        lost_after_m: open-loop distance beyond which the robot is lost. Source: method §3.4.
        greatest_gap_m: largest standard deviation of motion that odometry did not measure. Beyond
            it since the last match or saved node the robot is lost; beyond it in one gap an
            experience ends.
        followed_gap_m: largest standard deviation of motion, guessed or measured, along which a
            lost robot's evidence for places is propagated.
        guide_below_m, guide_below_rad: the prediction guides an attempt if its standard deviations
            are below both; 0 turns guidance off. Source: `lab/reports/constants.md`.
        lost_max_samples, lost_max_hypotheses: the matcher's bounds for attempts of a lost robot.
            They keep 98.7 % of the matches it would accept. Source: `lab/reports/constants.md`.
        neighbourhood, path_entries, success, lens_depth_m, fix_sigmas, earlier_doubt: see their
            descriptions.
        recent: how the ranking weights this session's recent attempts.
        hypotheses: how weak matches of a lost robot are confirmed.
        basin, lessons: what the map's attempts say of distance, and of each node.
        matcher, acceptance: settings of the two halves of an attempt.
        lookalikes: how runs of look-alikes are detected.
    """

    search_radius_m: Annotated[float, PUBLIC] = 8.0
    max_search_radius_m: Annotated[float, PUBLIC] = 30.0
    view_gate_rad: Annotated[float, PUBLIC] = float(np.deg2rad(60.0))
    own_exclusion_m: float = 30.0
    lost_after_m: Annotated[float, PUBLIC] = 10.0
    greatest_gap_m: float = 3.0
    followed_gap_m: float = 1.0
    guide_below_m: Annotated[float, PUBLIC] = 0.6
    guide_below_rad: Annotated[float, PUBLIC] = float(np.deg2rad(4.0))
    earlier_doubt: Annotated[
        float,
        Meta(
            ge=0,
            description="where a match is weak, the reported position is its mean with the one "
            "predicted from earlier matches, whose covariance is multiplied by this, as their "
            "errors are not independent; 0: the match alone",
        ),
    ] = 2.0
    lost_max_samples: int = 256
    lost_max_hypotheses: int = 100
    neighbourhood: Annotated[
        NeighbourhoodSearch,
        Meta(
            description="surest predicts a node by its least uncertain chain, proximity edges "
            "among them; breadth-first by its shortest, within the radius, as [G16] §III-A does"
        ),
        PUBLIC,
    ] = NeighbourhoodSearch.SUREST
    path_entries: Annotated[
        PathEntries,
        Meta(
            description="nodes on a path: all counts those that the drive saved, too; matches only "
            "those that it matched, as [L15] §IV does"
        ),
        PUBLIC,
    ] = PathEntries.ALL
    success: Annotated[
        Success,
        Meta(
            description="of several successes of a round, most-inliers keeps the best; first ends "
            "the frame with the highest ranked, as [L15] §III-C does"
        ),
        PUBLIC,
    ] = Success.MOST_INLIERS
    lens_depth_m: Annotated[
        float,
        Meta(
            ge=0,
            description="usual depth of what matches, m: a node of another focal length is most "
            "alike this far times 1 - f_live / f_node ahead; 0: lenses count as equal. Source: "
            "best offsets of two cameras in one street",
        ),
    ] = 7.0
    fix_sigmas: Annotated[
        float,
        Meta(
            ge=0,
            description="nodes within so many standard deviations of a satellite fix are proposed "
            "to a lost robot in an anchored map; a match decides; 0: fixes propose nothing",
        ),
        PUBLIC,
    ] = 3.0
    recent: RecentConfig = field(default_factory=RecentConfig)
    hypotheses: HypothesesConfig = field(default_factory=HypothesesConfig)
    basin: BasinConfig = field(default_factory=BasinConfig)
    lessons: LessonsConfig = field(default_factory=LessonsConfig)
    matcher: MatcherConfig = field(default_factory=MatcherConfig)
    acceptance: AcceptanceConfig = field(default_factory=AcceptanceConfig)
    lookalikes: LookalikeConfig = field(default_factory=LookalikeConfig)

    def __post_init__(self) -> None:
        for setting in fields(self):
            value = getattr(self, setting.name)
            if isinstance(value, float) and not 0 <= value < np.inf:
                raise ConfigError(f"localiser: {setting.name} is {value}, must be finite and >= 0")
        for name in ("lost_max_samples", "lost_max_hypotheses"):
            if getattr(self, name) < 1:
                raise ConfigError(f"localiser: {name} is {getattr(self, name)}, must be >= 1")

    @property
    def lost_matcher(self) -> MatcherConfig:
        """Settings of the first half of a lost robot's attempts."""
        return replace(
            self.matcher,
            max_samples=min(self.matcher.max_samples, self.lost_max_samples),
            max_hypotheses=min(self.matcher.max_hypotheses, self.lost_max_hypotheses),
        )
