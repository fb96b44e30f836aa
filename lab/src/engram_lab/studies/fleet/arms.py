"""The arms of the fleet study: with which policy and budget maps are built, merged and used."""

from __future__ import annotations

from dataclasses import dataclass

from engram.fleet.merge import NO_RELOCALISER, MergeOptions
from engram.robot import RobotOptions
from engram_lab.studies.configurations import UNLIMITED, Configuration


@dataclass(frozen=True, slots=True)
class Arm:
    """One policy and budget for everything: mapping, the replay of merges, held-out drives.

    Attributes:
        letter: key in `ARMS`.
        policy: key of `POLICIES`.
        lanes, rounds: Np and Nr; counts only, so that the same input gives the same maps.
        words: for tables and legends.
        sure_inliers: of `MergeOptions`.
    """

    letter: str
    policy: str
    lanes: int
    rounds: int
    words: str
    sure_inliers: int = MergeOptions().sure_inliers

    def mapping(self, relocaliser: str | None) -> RobotOptions:
        """How drives are mapped."""
        return RobotOptions(self.policy, self.lanes, self.rounds, relocaliser=relocaliser)

    def merging(self, relocaliser: str | None) -> MergeOptions:
        """How maps are merged."""
        return MergeOptions(
            self.policy,
            self.lanes,
            self.rounds,
            relocaliser or NO_RELOCALISER,
            sure_inliers=self.sure_inliers,
        )

    def localising(self, relocaliser: str | None) -> RobotOptions:
        """How drives are localised as on a robot."""
        return RobotOptions(self.policy, self.lanes, self.rounds, relocaliser=relocaliser)

    def judging(self, relocaliser: str | None) -> RobotOptions:
        """How orders of merging are judged."""
        return RobotOptions(self.policy, self.lanes, self.rounds, relocaliser=relocaliser)

    @property
    def configuration(self) -> Configuration:
        """How held-out drives are localised."""
        return Configuration(self.policy, self.lanes, self.rounds)


ARMS = {
    # [G16] §III-A: breadth first in the neighbourhood, nearest first, under a budget.
    "A": Arm("A", "distance", 2, 4, "distance, 8 attempts"),
    "B": Arm("B", "recall", 2, 4, "recall, 8 attempts"),
    # All candidates, one after another, until one is believed.
    "C": Arm("C", "distance", 1, UNLIMITED, "exhaustive"),
    # A as it was in the paper: whatever matches is omitted, also what other drives rely on.
    "P": Arm("P", "distance", 2, 4, "as A, every match omits", sure_inliers=0),
}
