"""What the fleet study runs on which drives, in which arms, and what it keeps of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from engram.cli.settings import AllSettings
from engram.config import to_dict
from engram.errors import ConfigError
from engram.fleet.merge.merge_settings import NO_RELOCALISER, MergeOptions
from engram.measures import Drive
from engram.robot.settings import RobotOptions, Settings
from engram_lab.studies.building import write_json
from engram_lab.studies.configurations import BY_TRUTH, UNLIMITED, Configuration
from engram_lab.studies.drives import DriveSet, EvaluatedDrive, Fold
from engram_lab.studies.in_force import Values, check_logs, check_lost
from engram_lab.studies.plan import StudyOptions, StudyPlan, all_tables, study_folder


@dataclass(frozen=True, slots=True)
class Arm:
    """One way to do everything."""

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
            relocaliser: one of `relocaliser_names()`, for robots; None for none.
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


EXPERIMENTS = (7, 8, 9, 10)
# Raise it whenever maps are merged otherwise, or more is recorded of maps and merges: studies of
# before are not gone on with.
_MERGING_VERSION = 4
# Source: method §8, [G16] §VI: docking after log 7; 4 groups of 9 logs for the orders.
_FORAY_LOGS = 7
_ORDER_GROUP_LOGS = 9
ROBOTS = ("r1", "r2")
# Tables of the settings that the study reads, beside the robots'.
VERBS = ("drive", "merge", "build", "download")
# What the robots download between their forays ([G16] Fig. 9).
FORAY_POLICIES = ("copy", "tod", "tod+paths")


@dataclass(frozen=True, slots=True)
class FleetOptions(StudyOptions):
    """What a fleet study runs.

    Attributes:
        tried: held-out drives of each fold that downloads are tried out on; None for all.
        relocaliser: of robots, as of every study, but by default the lost are found. Merges have
            that of the settings, where these tell of merging.
    """

    arms: tuple[str, ...] = USUAL_ARMS
    experiments: tuple[int, ...] = EXPERIMENTS
    groups: int = 4
    more_groups: tuple[int, ...] = (2, 8)
    order_groups: int = 4
    tried: int | None = None
    relocaliser: str | None = field(default="fabmap", kw_only=True)

    def __post_init__(self) -> None:
        StudyOptions.__post_init__(self)
        if self.relocaliser == BY_TRUTH:
            raise ConfigError(f"relocaliser is {BY_TRUTH}: a fleet's robots do not know the truth")
        for name, given, known in (
            ("arms", self.arms, tuple(ARMS)),
            ("experiments", self.experiments, EXPERIMENTS),
        ):
            strange = [one for one in given if one not in known]
            if strange or not given:
                raise ConfigError(
                    f"{name} are {given}, must be some of {', '.join(map(str, known))}"
                )
        if min(self.groups, *self.more_groups, self.order_groups) < 2:
            raise ConfigError(
                f"groups are {self.groups}, {self.more_groups} and {self.order_groups} for the "
                "orders; must be 2 or more"
            )


@dataclass(frozen=True, slots=True)
class Protocol:
    """[G16]'s numbers of logs, as far as a fold's training sessions go."""

    foray: int
    group: int
    validation: int

    @staticmethod
    def of(training: int, order_groups: int = 4) -> Protocol:
        """For so many training sessions."""
        least = max(2 * 2, order_groups + 1)
        if training < least:
            raise ConfigError(
                f"{training} training sessions are too few for two robots with two forays each and "
                f"for {order_groups} groups and a validation session; {least} are needed"
            )
        validation = max(training // 8, 1)
        return Protocol(
            foray=min(_FORAY_LOGS, training // 4),
            group=min(_ORDER_GROUP_LOGS, (training - validation) // order_groups),
            validation=validation,
        )


@dataclass(frozen=True, slots=True)
class FleetPlan(StudyPlan[FleetOptions]):
    """All that a worker needs."""

    @property
    def arms(self) -> tuple[Arm, ...]:
        """Those requested."""
        relocaliser = self.options.relocaliser
        return tuple(ARMS[one].under(self.tables, one, relocaliser) for one in self.options.arms)

    def folder(self, arm: Arm, fold: Fold) -> Path:
        """Where one arm's maps and results of one fold lie."""
        return self.work / f"arm-{arm.letter}" / f"fold{fold.number}"

    def protocol(self, fold: Fold) -> Protocol:
        """Numbers of logs."""
        return Protocol.of(len(fold.training), self.options.order_groups)

    def forays(self, fold: Fold) -> dict[str, list[list[EvaluatedDrive]]]:
        """Each robot's two forays: drives spread over the training sessions, turn about."""
        logs = self.protocol(fold).foray
        chosen = _spread(self.training(fold), 2 * 2 * logs)
        return {
            robot: [chosen[number::2][:logs], chosen[number::2][logs:]]
            for number, robot in enumerate(ROBOTS)
        }

    def groups(self, fold: Fold, count: int) -> list[list[EvaluatedDrive]]:
        """All training sessions in chronological groups, sizes within one."""
        drives = self.training(fold)
        return [[drives[k] for k in part] for part in np.array_split(np.arange(len(drives)), count)]

    def group_counts(self, fold: Fold) -> tuple[int, ...]:
        """How many groups the parallel build is tried with, the usual number first."""
        more = self.options.more_groups if fold.number == 0 else ()
        wanted = dict.fromkeys((self.options.groups, *more))
        return tuple(one for one in wanted if one <= len(fold.training))

    def order_groups(self, fold: Fold) -> list[list[EvaluatedDrive]]:
        """The chronological groups whose orders are tried."""
        validation = {one.path for one in self.validation(fold)}
        rest = [one for one in self.training(fold) if one.path not in validation]
        size = self.protocol(fold).group
        chosen = _spread(rest, self.options.order_groups * size)
        return [chosen[k : k + size] for k in range(0, len(chosen), size)]

    def validation(self, fold: Fold) -> list[EvaluatedDrive]:
        """The drives by which the best order is chosen: neither mapped nor reported on."""
        return _spread(self.training(fold), self.protocol(fold).validation)

    def configuration(self) -> dict[str, Any]:
        """The resolved configuration, kept with the results."""
        return {
            **StudyPlan.configuration(self),
            "protocol": [to_dict(self.protocol(one)) for one in self.folds],
            "arms": [to_dict(one) for one in self.arms],
        }


def make_fleet_plan(
    drives: DriveSet, settings: Settings, options: FleetOptions, work: Path
) -> FleetPlan:
    """A plan; its folder below `work` depends on all that its maps and results depend on.

    More arms or experiments may be run later, and find there what was done.
    """
    check_logs(settings, drives)
    check_lost(settings, options.relocaliser)
    tables = all_tables(settings, drives.drives[0].descriptor)
    if not isinstance(settings, AllSettings):
        merging = replace(tables.merge, relocaliser=options.relocaliser or NO_RELOCALISER)
        tables = replace(tables, merge=merging)
    settings = tables.of_robot()
    depends = (
        drives.hash,
        options.folds,
        options.seed,
        options.relocaliser,
        _MERGING_VERSION,
        *(to_dict(getattr(tables, name)) for name in VERBS),
    )
    folder = study_folder(work, f"fleet-{drives.name}", depends, settings)
    plan = FleetPlan(drives, settings, options, folder, tables)
    for arm in plan.arms:
        arm.driving.lane_threads(maps=True)  # refuses too few before anything is run
    for fold in plan.folds:
        plan.protocol(fold)  # raises where there are too few
    plan.begin()
    return plan


def _spread(drives: Sequence[EvaluatedDrive], count: int) -> list[EvaluatedDrive]:
    """So many of the drives, evenly over them."""
    rows = np.floor((np.arange(count) + 0.5) * len(drives) / count).astype(int)
    return [drives[row] for row in rows]


@dataclass(frozen=True, slots=True)
class MergeRecord:
    """One merge into a centre.

    Attributes:
        attempts, proposed, lookups: match attempts, those of them at proposed nodes, and nodes for
            which the relocaliser was asked.
    """

    name: str
    nodes: int
    components: int
    taken: int
    omitted: int
    frames: int
    attempts: int
    proposed: int
    lookups: int
    seconds: float
    in_force: Values = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DownloadRecord:
    """One download for a foray.

    Attributes:
        policy: key of `SELECTIONS`; another than was asked for where nothing was driven at that
            hour.
        start_h: hour of day that it was made for; None if it is not known.
        size_bytes, of_bytes: of the file, and of the centre's.
    """

    policy: str
    start_h: float | None
    nodes: int
    of_nodes: int
    united: int
    size_bytes: int
    of_bytes: int
    in_force: Values = field(default_factory=dict)


def write_record(path: Path, record: Any) -> None:
    """Writes a dataclass."""
    write_json(path, to_dict(record))


def read_json(path: Path) -> Any:
    """What `write_record` wrote, as plain values."""
    return json.loads(path.read_text(encoding="utf-8"))


def read_merge(path: Path) -> MergeRecord | None:
    """What a merge came to; None if it is still to be done."""
    return MergeRecord(**read_json(path)) if path.exists() else None


def read_download(path: Path) -> DownloadRecord | None:
    """What a download came to; None if it is still to be done."""
    return DownloadRecord(**read_json(path)) if path.exists() else None


def write_drive(path: Path, drive: Drive, frame_ms: list[float]) -> None:
    """How a drive went in the field: in one step."""
    draft = path.with_name(f".{path.name}.part.npz")
    np.savez_compressed(draft, step_m=drive.step_m, matched=drive.matched, frame_ms=frame_ms)
    draft.replace(path)


def read_drive(path: Path) -> tuple[Drive, float] | None:
    """How a drive went in the field, and mean ms of localising a frame; None if it did not yet."""
    if not path.exists():
        return None
    with np.load(path) as kept:
        return Drive(kept["step_m"], kept["matched"]), float(kept["frame_ms"].mean())
