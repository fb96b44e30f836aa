"""The arms of the fleet study: with which policy and budget maps are built, merged and used."""

from __future__ import annotations

from dataclasses import dataclass, replace

from engram.cli.settings import AllSettings
from engram.fleet.merge import MergeOptions
from engram.robot import RobotOptions
from engram_lab.studies.configurations import UNLIMITED, Configuration


@dataclass(frozen=True, slots=True)
class Arm:
    """One way to do everything.

    Attributes:
        letter: key in `ARMS`.
        words: for tables and legends.
        driving: how drives are mapped, localised as on a robot, and judge orders of merging.
        merging: how maps are merged.
    """

    letter: str
    words: str
    driving: RobotOptions
    merging: MergeOptions

    @property
    def configuration(self) -> Configuration:
        """How held-out drives are localised."""
        return Configuration(self.driving.ranking, self.driving.lanes, self.driving.rounds)


@dataclass(frozen=True, slots=True)
class ArmRule:
    """What an arm sets; all else is as the settings say.

    Attributes:
        words: for tables and legends.
        policy: key of `POLICIES`, for driving and merging; None for those of the settings.
        lanes, rounds: Np and Nr of both, with the policy; counts only, so that the same input
            gives the same maps.
        sure_inliers: of `MergeSettings`; None for those of the settings.
    """

    words: str
    policy: str | None = None
    lanes: int = 0
    rounds: int = 0
    sure_inliers: int | None = None

    def under(self, settings: AllSettings, letter: str, relocaliser: str | None) -> Arm:
        """The arm under some settings.

        Args:
            settings: the tables `drive` and `merge` say what the arm leaves open.
            letter: key in `ARMS`.
            relocaliser: key of `RELOCALISERS`, for robots; None for none.
        """
        drive, merging = settings.drive, MergeOptions.of(settings.merge)
        driving = RobotOptions(
            drive.ranking,
            drive.lanes,
            drive.rounds,
            relocaliser=relocaliser,
            threads=drive.threads,
        )
        if self.policy is not None:
            policy, lanes, rounds = self.policy, self.lanes, self.rounds
            driving = replace(driving, ranking=policy, lanes=lanes, rounds=rounds)
            merging = replace(merging, ranking=policy, lanes=lanes, rounds=rounds)
        if self.sure_inliers is not None:
            merging = replace(merging, sure_inliers=self.sure_inliers)
        return Arm(letter, self.words, driving, merging)


# What is run unless told.
USUAL_ARMS = ("A", "B", "C")
AS_SET = "S"
ARMS = {
    "A": ArmRule("distance, 8 attempts", "distance", 2, 4),
    "B": ArmRule("recall, 8 attempts", "recall", 2, 4),
    # All candidates, one after another, until one is believed.
    "C": ArmRule("exhaustive", "distance", 1, UNLIMITED),
    # Whatever matches is omitted, also what other drives rely on, as in [G16] §V-A.
    "P": ArmRule("as A, every match omits", "distance", 2, 4, sure_inliers=0),
    # The papers', with their settings.
    AS_SET: ArmRule("as the settings say"),
}
# What arms other than `AS_SET` set themselves.
_SET_BY_ARMS = (
    ("drive", ("ranking", "lanes", "rounds")),
    ("merge", ("ranking", "lanes", "rounds", "sure_inliers")),
)


def arms_for(settings: AllSettings) -> tuple[str, ...]:
    """The arms to run by default: that of the settings where they set what arms would."""
    usual = AllSettings()
    changed = any(
        getattr(getattr(settings, table), name) != getattr(getattr(usual, table), name)
        for table, names in _SET_BY_ARMS
        for name in names
    )
    return (AS_SET,) if changed else USUAL_ARMS
