"""All orders of merging four groups, judged on validation drives, reported on others (Fig. 10)."""

from __future__ import annotations

from collections.abc import Sequence

from engram.fleet.build import JudgeOptions, find_best_order
from engram.maps import Map
from engram.measures import Drive
from engram.monitor import QUIET
from engram.robot import DriveSequence, RobotOptions, Settings, session_of_drive
from engram_lab.studies.configurations import Configuration
from engram_lab.studies.fleet.arms import Arm
from engram_lab.studies.fleet.plan import FleetPlan
from engram_lab.studies.fleet.records import write_record
from engram_lab.studies.fleet.steps import map_path
from engram_lab.studies.folds import Fold
from engram_lab.studies.held_out import localise_held_out
from engram_lab.studies.memo import MatchMemo


class _Judge:
    """Localises the drives that orders are judged by; what two orders share is matched once."""

    def __init__(self, plan: FleetPlan, arm: Arm, fold: Fold) -> None:
        self._plan = plan
        self._arm = arm
        self._fold = fold
        self._drives = {one.session.id: one for one in plan.drives.drives}

    def __call__(
        self, opened: Map, sequence: DriveSequence, settings: Settings, options: RobotOptions
    ) -> Drive:
        """See `JudgeOptions.localise`."""
        drive = self._drives[session_of_drive(sequence).id]
        folder = self._plan.folder(self._arm, self._fold)
        memo = MatchMemo.of(opened, drive, settings, folder)
        configuration = Configuration(options.ranking, options.lanes, options.rounds)
        runs = localise_held_out(
            opened, drive, drive.frames(), self._plan.training(self._fold), [configuration],
            settings, memo, options.relocaliser,
        )  # fmt: skip
        memo.save()
        return Drive(runs.step_m, runs.matched[0])


def try_orders(plan: FleetPlan, arm: Arm, fold: Fold, names: Sequence[str]) -> None:
    """Merges the groups in all orders, and keeps the results in ``orders.json``.

    Args:
        plan: the study.
        arm: policy and budget.
        fold: whose held-out drives are reported on.
        names: of the groups' maps.
    """
    folder = plan.folder(arm, fold)
    path = folder / "orders.json"
    if path.exists():
        return
    judge = JudgeOptions(
        [one.path for one in plan.validation(fold)],
        judge_at_m=plan.tables.build.max_gap_m,
        localising=arm.driving,
        reported=[one.path for one in plan.held_out(fold)],
        localise=_Judge(plan, arm, fold),
        estimator=plan.tables.build.estimator,
    )
    found = find_best_order(
        [map_path(plan, arm, fold, name) for name in names],
        folder / "orders",
        plan.settings,
        arm.merging,
        judge,
        QUIET,
    )
    write_record(path, found.to_dict())
