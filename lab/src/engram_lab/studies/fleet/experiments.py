"""[G16]'s experiments as lists of tasks: which maps are made of what, and who is localised in them.

Maps are named after what they are: ``single``; ``group4-0`` … and ``merged4-3``, into which the
first group's map and three more went; ``pairs4-…`` of the pairwise tree; ``r1``, ``r2`` of the
robots by themselves after both forays; ``docked``, what the centre knows after their first; and
``r1-tod``, what r1 has after a second foray in such a download; ``shared`` is what the centre knows
in the end, both robots having driven in a copy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from engram.monitor import QUIET, Monitor
from engram_lab.studies.drives import EvaluatedDrive, Fold
from engram_lab.studies.fleet.plan import FORAY_POLICIES, ROBOTS, Arm, FleetPlan
from engram_lab.studies.fleet.steps import (
    download_for_foray,
    kept_maps,
    localise_in,
    map_drives,
    measure_stages,
    merge,
    try_downloads_for,
    try_orders,
)
from engram_lab.studies.plan import Task

SINGLE = "single"
DOCKED = "docked"
SHARED = "shared"
# Whose counts become times. The first of those asked for measures the medians, in its first map:
# Fig. 7's is of all training drives, so that it comes first.
_TIMED = (7, 9, 10)


def merged_name(groups: int, merges: int) -> str:
    """The centre that so many of the groups' maps were merged into."""
    return f"merged{groups}-{merges}" if merges else f"group{groups}-0"


def run_fleet(plan: FleetPlan, workers: int = 1, monitor: Monitor = QUIET) -> None:
    """Runs what is missing of a study."""
    plan.run(fleet_tasks(plan), workers, monitor, kept_maps.close)


def fleet_tasks(plan: FleetPlan) -> list[Task]:
    """All that a study runs: arm by arm, fold by fold."""
    tasks: list[Task] = []
    for arm in plan.arms:
        for fold in plan.run_folds:
            tasks += _Tasks(plan, arm, fold).all()
    return tasks


@dataclass(frozen=True, slots=True)
class PairMerge:
    """One merge of the pairwise tree."""

    level: int
    name: str
    centre: str
    robot: str


def pair_merges(groups: int) -> list[PairMerge]:
    """The merges of neighbours, pair by pair, until one map is left."""
    found: list[PairMerge] = []
    maps = [f"group{groups}-{number}" for number in range(groups)]
    level = 0
    while len(maps) > 1:
        above = []
        for number in range(0, len(maps) - 1, 2):
            name = f"pairs{groups}-{level}-{number // 2}"
            found.append(PairMerge(level, name, maps[number], maps[number + 1]))
            above.append(name)
        maps = above + maps[len(maps) - len(maps) % 2 :]
        level += 1
    return found


class _Tasks:
    """The tasks of one arm in one fold."""

    def __init__(self, plan: FleetPlan, arm: Arm, fold: Fold) -> None:
        self._plan = plan
        self._arm = arm
        self._fold = fold
        self._about = (plan, arm, fold)

    def all(self) -> list[Task]:
        """Each behind those that it needs; with what several experiments need only once."""
        wanted = self._plan.options.experiments
        tasks: list[Task] = []
        if 7 in wanted:
            tasks += self._parallel_building()
        if 8 in wanted or 9 in wanted:
            tasks += self._first_forays()
            tasks += self._forays(("copy",))
            tasks += self._sharing()
        if 8 in wanted:
            tasks += self._alone()
        if 9 in wanted:
            tasks += self._forays(FORAY_POLICIES)
            tasks += self._downloads()
        if 10 in wanted and self._fold.number == 0:
            tasks += self._orders()
        return list({task.name: task for task in reversed(tasks)}.values())[::-1]

    def _parallel_building(self) -> Iterator[Task]:
        """Fig. 7: one agent against groups side by side, merged one after another."""
        yield from self._mapped(SINGLE, self._plan.training(self._fold))
        yield from self._measured(7, SINGLE)
        shown = [SINGLE]
        for groups in self._plan.group_counts(self._fold):
            for number, drives in enumerate(self._plan.groups(self._fold, groups)):
                yield from self._mapped(f"group{groups}-{number}", drives)
            for number in range(1, groups):
                yield self._merged(
                    merged_name(groups, number), merged_name(groups, number - 1),
                    f"group{groups}-{number}",
                )  # fmt: skip
            shown.append(merged_name(groups, groups - 1))
        groups = self._plan.options.groups
        if groups <= len(self._fold.training):
            pairs = pair_merges(groups)
            for one in pairs:
                yield self._merged(one.name, one.centre, one.robot)
            shown.append(pairs[-1].name)
        yield from self._localised(shown)

    def _first_forays(self) -> Iterator[Task]:
        """Both robots drive by themselves, then dock."""
        for robot, (first, _) in self._plan.forays(self._fold).items():
            yield from self._mapped(f"{robot}-first", first)
        yield from self._measured(9, f"{ROBOTS[0]}-first")
        yield self._merged(DOCKED, "r1-first", "r2-first")

    def _forays(self, policies: Sequence[str]) -> Iterator[Task]:
        """The second forays, in downloads of what both have."""
        for robot, (first, second) in self._plan.forays(self._fold).items():
            for policy in policies:
                name = f"{robot}-{policy}"
                base = f"{name}-download"
                work = partial(
                    download_for_foray, *self._about, base, DOCKED, policy, first, second
                )
                yield self._task(base, work, [DOCKED])
                yield from self._mapped(name, second, base)

    def _sharing(self) -> Iterator[Task]:
        """Both hand in what they added to their copies; the held-out drives in the result."""
        yield self._merged("shared-1", DOCKED, "r1-copy")
        yield self._merged(SHARED, "shared-1", "r2-copy")
        yield from self._localised([SHARED])

    def _alone(self) -> Iterator[Task]:
        """Fig. 8: each robot by itself, both forays."""
        for robot, (_, second) in self._plan.forays(self._fold).items():
            yield from self._mapped(robot, second, f"{robot}-first")
        yield from self._localised(ROBOTS)

    def _downloads(self) -> Iterator[Task]:
        """Fig. 9's table: downloads of the shared map for each held-out drive's own hour."""
        for drive in self._plan.held_out(self._fold)[: self._plan.options.tried]:
            work = partial(try_downloads_for, *self._about, SHARED, drive)
            yield self._task(f"downloads {drive.key}", work, [SHARED], "downloads", alone=True)

    def _orders(self) -> Iterator[Task]:
        """Fig. 10: the groups in all orders."""
        groups = self._plan.order_groups(self._fold)
        names = [f"orders-{number}" for number in range(len(groups))]
        for name, drives in zip(names, groups, strict=True):
            yield from self._mapped(name, drives)
        yield from self._measured(10, names[0])
        yield self._task("orders", partial(try_orders, *self._about, names), names, "orders")
        in_sequence = [drive for drives in groups for drive in drives]
        yield from self._mapped("orders-sequential", in_sequence)
        yield from self._localised(["orders-sequential"])

    # -- one kind of step each

    def _mapped(
        self, name: str, drives: Sequence[EvaluatedDrive], base: str | None = None
    ) -> Iterator[Task]:
        """One task per drive; the last bears the name of the map."""
        before = [] if base is None else [base]
        for count in range(1, len(drives) + 1):
            step = name if count == len(drives) else f"{name}+{count}"
            work = partial(map_drives, *self._about, name, drives[:count], base)
            yield self._task(step, work, before, f"{name} {count}/{len(drives)}")
            before = [step]

    def _measured(self, experiment: int, name: str) -> Iterator[Task]:
        """The medians, in an experiment's first map; nothing if another one measures them."""
        wanted = self._plan.options.experiments
        if experiment == next((one for one in _TIMED if one in wanted), None):
            yield self._task("stages", partial(measure_stages, *self._about, name), [name])

    def _merged(self, name: str, centre: str, robot: str) -> Task:
        return self._task(name, partial(merge, *self._about, name, centre, robot), [centre, robot])

    def _localised(self, names: Sequence[str]) -> Iterator[Task]:
        for drive in self._plan.held_out(self._fold):
            work = partial(localise_in, *self._about, drive, names)
            yield self._task(f"localise {drive.key} in {','.join(names)}", work, names, "localise")

    def _task(
        self, name: str, work: object, needs: Sequence[str], word: str = "", *, alone: bool = False
    ) -> Task:
        scope = f"{self._arm.letter}{self._fold.number} "
        assert callable(work)
        words = f"{scope}{word or name}"
        return Task(scope + name, work, tuple(scope + one for one in needs), words, alone)
