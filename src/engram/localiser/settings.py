"""Settings of the localiser."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np

from engram.errors import ConfigError
from engram.frontend.matching import MatcherConfig
from engram.localiser.acceptance import AcceptanceConfig
from engram.ranking import RecentConfig

# Raise it whenever drives are localised or mapped otherwise with equal settings: studies that were
# kept under another one are not gone on with.
METHOD_VERSION = 3


@dataclass(frozen=True, slots=True)
class LocaliserConfig:
    """Settings of the localiser.

    Attributes:
        search_radius_m: least radius of the neighbourhood. Source: SPEC §3, 8 m.
        max_search_radius_m: largest, however uncertain the position; the match basin where that is
            wider. Past it a robot is found by its relocaliser, not by trying everything around.
        view_gate_rad: largest difference of heading to a candidate. Source: SPEC §3, 60°.
        own_exclusion_m: own nodes saved within the last so many metres are no candidates.
            Source: SPEC §3.1, 30 m.
        lost_after_m: open loop distance past which the robot is lost. Source: SPEC §3.4, 10 m.
        greatest_gap_m: largest standard deviation of motion that odometry did not measure. Past it
            since the last match or saved node the robot is lost; past it at a stretch an
            experience ends.
        guide_below_m, guide_below_rad: an attempt is guided by the prediction where its standard
            deviations lie below both; 0 turns guidance off.
        lost_max_samples, lost_max_hypotheses: bounds of the matcher's for the attempts of a lost
            robot. Nearly all of them are in vain, and cost 1.1 ms without, 0.27 ms with these
            bounds; matches that it would believe have so many inliers that 98.8 % of them are
            found all the same (measured as in `AcceptanceConfig`).
        recent: what the ranking remembers of this session's attempts.
        matcher, acceptance: settings of the two halves of an attempt.
    """

    search_radius_m: float = 8.0
    max_search_radius_m: float = 30.0
    view_gate_rad: float = float(np.deg2rad(60.0))
    own_exclusion_m: float = 30.0
    lost_after_m: float = 10.0
    greatest_gap_m: float = 3.0
    guide_below_m: float = 0.3
    guide_below_rad: float = float(np.deg2rad(3.0))
    lost_max_samples: int = 500
    lost_max_hypotheses: int = 100
    recent: RecentConfig = field(default_factory=RecentConfig)
    matcher: MatcherConfig = field(default_factory=MatcherConfig)
    acceptance: AcceptanceConfig = field(default_factory=AcceptanceConfig)

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if isinstance(value, float) and not 0 <= value < np.inf:
                raise ConfigError(f"localiser: {one.name} is {value}, must be finite and >= 0")
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
