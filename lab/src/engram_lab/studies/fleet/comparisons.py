"""What [G16] claims as pairs and ratios: times, nodes, and the route that held-out drives miss."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from engram.fleet.build import order_costs
from engram_lab.studies.fleet.experiments import SHARED, SINGLE, merged_name, pair_merges
from engram_lab.studies.fleet.plan import ROBOTS
from engram_lab.studies.fleet.results import ArmResult, FoldResult, Parallel, Time, slowest, total
from engram_lab.studies.fleet.stages import Counts
from engram_lab.studies.fleet.trials import (
    AS_TOD,
    AS_TOD_PATHS,
    COPY,
    QUARTER,
    TENTH,
    TOD,
    TOD_PATHS,
)
from engram_lab.studies.pages import Row, compared_drives


def comparison_rows(arm: ArmResult) -> list[Row]:
    """All of one arm; of the requested experiments."""
    about = {"campaign": arm.plan.drives.name, "arm": arm.arm.letter}
    of = {7: _building, 8: _sharing, 9: _downloads, 10: _orders}
    return [
        {**about, "experiment": number, **row}
        for number, rows in of.items()
        if arm.asked(number)
        for row in rows(arm)
    ]


def _building(arm: ArmResult) -> Iterator[Row]:
    """Fig. 7."""
    main = arm.plan.options.groups
    for groups in arm.plan.group_counts(arm.plan.folds[0]):
        whole = _whole(arm, groups)
        if not whole:
            continue
        single = [fold.time_of(fold.single() or []) for fold, _ in whole]
        what = f"{groups} groups, merged one after another, ÷ one agent"
        paper = ("29.36 %", "67.57 %", "21.97 against 32.03 %") if groups == main else ("", "", "")
        yield from _times(what, [built.time for _, built in whole], single, paper[0])
        alone = [slowest(built.group_times) for _, built in whole]
        yield from _times(f"{groups} groups: the slowest ÷ one agent", alone, single)
        agents = sum((fold.single() or [])[-1].nodes for fold, _ in whole)
        merged = sum(built.nodes for _, built in whole)
        yield _ratio(f"{what}: nodes", merged, agents, paper[1])
        name = merged_name(groups, groups - 1)
        yield from _held_out(
            arm, f"{groups} groups merged against one agent", name, SINGLE, paper[2]
        )
        pairwise = [built.pairwise_time for _, built in whole if built.pairwise_time is not None]
        if groups == main and len(pairwise) == len(whole):
            what = f"{groups} groups, merged as a pairwise tree, ÷ one agent"
            yield from _times(what, pairwise, single)
            tree = sum(built.pairs[-1][1].nodes for _, built in whole)
            yield _ratio(f"{what}: nodes", tree, agents)
            name = pair_merges(groups)[-1].name
            yield from _held_out(arm, "pairwise tree against one agent", name, SINGLE)


def _whole(arm: ArmResult, groups: int) -> list[tuple[FoldResult, Parallel]]:
    """Folds in which both ways of building are complete."""
    found = [(fold, fold.parallel(groups)) for fold in arm.folds if fold.single() is not None]
    return [(fold, built) for fold, built in found if built is not None]


def _times(what: str, above: Sequence[Time], below: Sequence[Time], paper: str = "") -> list[Row]:
    a, b = total(above), total(below)
    return [
        _ratio(f"{what}: time by counts", a.counted_s, b.counted_s, paper),
        _ratio(f"{what}: time by the clock", a.wall_s, b.wall_s),
    ]


def _ratio(what: str, part: float | None, whole: float | None, paper: str = "") -> Row:
    """One by the other; nothing where either was not measured, or nothing was counted."""
    known = None if part is None or not whole else part / whole
    return {"what": what, "paper": paper, "ratio": known}


def _sharing(arm: ArmResult) -> Iterator[Row]:
    """Fig. 8."""
    for robot in ROBOTS:
        yield from _held_out(arm, f"shared map against {robot}'s own", SHARED, robot, "better")


def _held_out(arm: ArmResult, what: str, a: str, b: str, paper: str = "") -> Iterator[Row]:
    found = arm.held_out(a, b)
    if found is not None:
        ours, theirs = (one.drives for one in found)
        yield compared_drives(what, ours, theirs, arm.plan.options.seed, paper)


def _downloads(arm: ArmResult) -> Iterator[Row]:
    """Fig. 9."""
    seed, copied = arm.plan.options.seed, arm.forays(COPY)
    for policy, paper in (
        (TOD, "81.77 and 79.57 % (united)"),
        (TOD_PATHS, "74.56 and 66.57 % (united)"),
    ):
        driven, taken = arm.forays(policy), arm.downloads(policy)
        if not driven or len(driven) != len(copied):
            continue
        whole = sum(one.of_nodes for one in taken)
        what = f"second foray in one `{policy}` download"
        yield _ratio(f"{what}: nodes taken along", sum(one.nodes for one in taken), whole)
        united = sum(one.united for one in taken)
        yield _ratio(f"{what}: united with the robot's own", united, whole, paper)
        others = sum(one.policy != policy for one in taken)
        a, b = ([one.drive for one in some] for some in (driven, copied))
        row = compared_drives(f"{what} against `{COPY}`", a, b, seed, "slightly worse")
        yield {**row, "asked_for_more": others}
    trials = arm.trials()
    for name, other in (
        *((one, COPY) for one in (TOD, TOD_PATHS, QUARTER, TENTH)),
        (AS_TOD, TOD),
        (AS_TOD_PATHS, TOD_PATHS),
    ):
        others_of = {drive.session.id: one for drive, one in trials.get(other, [])}
        pairs = [
            (one, others_of[drive.session.id])
            for drive, one in trials.get(name, [])
            if drive.session.id in others_of
        ]
        if pairs:
            a, b = ([pair[k].drive for pair in pairs] for k in (0, 1))
            yield compared_drives(f"`{name}` against `{other}`, each for its drive", a, b, seed)


def _orders(arm: ArmResult) -> Iterator[Row]:
    """Fig. 10."""
    fold = arm.folds[0]
    found = fold.orders()
    if found is None:
        return
    count = f"{len(found['orders'])} orders of {len(fold.order_groups())} groups"
    for what, part, whole, paper in _order_times(fold, found):
        yield _ratio(f"{count}: {what}", part, whole, paper)
    driven = fold.held_out("orders-sequential")
    if driven and found["orders"]:
        row = {"what": "chosen order against one agent with the same drives"}
        missed = sum(one.drive.step_m[~one.drive.matched].sum() for one in driven)
        route = sum(one.drive.step_m.sum() for one in driven)
        chosen = found["orders"][0]["reported_missed"]
        yield {**row, "share_a": chosen, "share_b": float(missed / route), "drives": len(driven)}


def _order_times(
    fold: FoldResult, found: dict[str, Any]
) -> Iterator[tuple[str, float | None, float | None, str]]:
    """By (8), against a prefix tree, and one order really built; None for what is not timed."""
    groups = fold.order_groups()
    groups_s = total(fold.time_of(one) for one in groups).counted_s
    merges_s = fold.counted(
        Counts(found["replayed"], found["attempts"], found["proposed"], found["lookups"])
    )
    names = (
        "by (8) ÷ sequential", "as a prefix tree ÷ sequential",
        "as a prefix tree ÷ a sequential prefix tree",
        "later groups of one that was built ÷ (k − 1)·T_G of (8)",
    )  # fmt: skip
    if groups_s is None or merges_s is None:
        yield from ((name, None, None, "") for name in names)
        return
    group_s, merge_s = groups_s / len(groups), merges_s / max(found["merges"], 1)
    costs = order_costs(len(groups), group_s, merge_s, found["copy_s"] / max(found["copies"], 1))
    built = fold.sequential()
    rest_s = fold.time_of(built[len(groups[0]) :]).counted_s if built else None
    yield names[0], costs.model_s, costs.sequential_s, "22.44 %"
    yield names[1], costs.tree_s, costs.sequential_s, ""
    yield names[2], costs.tree_s, costs.sequential_tree_s, ""
    yield names[3], rest_s, (len(groups) - 1) * group_s, "100 % (assumed)"
