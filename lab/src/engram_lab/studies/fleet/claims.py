"""What [G16] claims, beside what was measured: a page in Markdown, losing rows kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import Any, TypeAlias

import numpy as np

from engram.fleet.build import order_costs
from engram.measures import route_not_localised
from engram_lab.intervals import Resamples, not_localised_sums
from engram_lab.studies.fleet.experiments import SHARED, SINGLE, merged_name, pair_merges
from engram_lab.studies.fleet.plan import ROBOTS
from engram_lab.studies.fleet.records import DownloadRecord
from engram_lab.studies.fleet.results import (
    ArmResult,
    FoldResult,
    InField,
    Parallel,
    Time,
    Trials,
    slowest,
    total,
)
from engram_lab.studies.fleet.stages import Counts
from engram_lab.studies.fleet.trials import (
    AS_TOD,
    AS_TOD_PATHS,
    COPY,
    QUARTER,
    TENTH,
    TOD,
    TOD_PATHS,
    TriedDownload,
)
from engram_lab.studies.wording import CLAIM_COLUMNS, Row, against, share, table

# Source: [G16] Figs. 7 and 9, §VI-E.
_PAPER_NODES = {TOD: "81.77 and 79.57 % (united)", TOD_PATHS: "74.56 and 66.57 % (united)"}
_MUST_NODES = {TOD: "≤ 45 %", TOD_PATHS: "≤ 30 %"}
_MUST_POINTS = {
    TOD: "within 2 points",
    TOD_PATHS: "within 3 points",
    QUARTER: "within 2 points",
    TENTH: "–",
}
_AIM_POINTS = {QUARTER: "within 1 point", TENTH: "within 3 points"}


def fleet_claims_page(arms: Sequence[ArmResult]) -> str:
    """A table per campaign and experiment, with a column per arm.

    Intervals are 90 %, paired, by bootstrap over sessions.
    """
    lines: list[str] = []
    for _, of_campaign in groupby(arms, key=lambda arm: arm.plan.work):
        lines += _campaign(list(of_campaign))
    return "\n".join(lines)


def _campaign(arms: Sequence[ArmResult]) -> Iterator[str]:
    yield from (f"## {arms[0].plan.drives.name}", "", _protocol(arms[0]), "")
    yield from (_medians(arm) for arm in arms if arm.stages is not None)
    for number, (title, of) in _TABLES.items():
        rows = _side_by_side([list(of(arm)) if arm.asked(number) else [] for arm in arms])
        if rows:
            columns = (f"{arm.arm.letter}: {arm.arm.words}" for arm in arms)
            yield from ("", f"### {title} (Fig. {number})", "")
            yield from table((*_COLUMNS, *columns), rows)


def _side_by_side(of_arms: Sequence[list[Row]]) -> list[tuple[str, ...]]:
    """What is claimed, and what was measured in each arm; a dash where it was not."""
    claims = dict.fromkeys(row[:-1] for rows in of_arms for row in rows)
    measured = [{row[:-1]: row[-1] for row in rows} for rows in of_arms]
    return [(*claim, *(of.get(claim, "–") for of in measured)) for claim in claims]


def _protocol(arm: ArmResult) -> str:
    """How many logs there were: [G16]'s protocols are scaled to them."""
    fold = arm.plan.folds[0]
    protocol, groups = arm.plan.protocol(fold), arm.plan.groups(fold, arm.plan.options.groups)
    return (
        f"{len(arm.plan.drives.drives)} drives, {arm.plan.options.folds} folds, "
        f"{len(fold.training)} training drives in the first; {len(groups)} groups of "
        f"{len(groups[-1])} to {len(groups[0])} (Fig. 7); forays of {protocol.foray} (7 in the "
        f"paper; Figs. 8 and 9); groups of {protocol.group} (9 in the paper) for the orders, "
        f"chosen on {protocol.validation} validation drives (Fig. 10). Saving, front-end and "
        "odometry are not counted: every drive passes through them once whichever way a map is "
        "built."
    )


def _medians(arm: ArmResult) -> str:
    assert arm.stages is not None
    return (
        f"- Medians of arm {arm.arm.letter} on one core: {arm.stages.frame_ms:.2f} ms a frame, "
        f"{arm.stages.attempt_ms:.2f} ms an attempt, {arm.stages.proposed_ms:.2f} ms one of a "
        f"lost robot at a proposed node, {arm.stages.lookup_ms:.2f} ms a look-up."
    )


def _building(arm: ArmResult) -> Iterator[Row]:
    """Fig. 7."""
    main = arm.plan.options.groups
    for groups in arm.plan.group_counts(arm.plan.folds[0]):
        whole = _whole(arm, groups)
        if not whole:
            continue
        is_main = groups == main
        single = [fold.time_of(fold.single() or []) for fold, _ in whole]
        parallel = [built.time for _, built in whole]
        yield (
            f"time of {groups} groups side by side, then merges one after another, ÷ one agent's",
            "29.36 %" if is_main else "–",
            "≤ 45 % (arm A)" if is_main else "–",
            "≤ 30 %" if is_main else "",
            f"{_ratio(parallel, single)}; slowest group alone "
            f"{_ratio([slowest(built.group_times) for _, built in whole], single)}; "
            f"{_folds(len(whole))}",
        )
        pairwise = [built.pairwise_time for _, built in whole]
        if is_main and all(pairwise):
            yield (
                "the same, merged as a pairwise tree", "–", "printed", "",
                _ratio([one for one in pairwise if one], single),
            )  # fmt: skip
        agents = sum((fold.single() or [])[-1].nodes for fold, _ in whole)
        merged = sum(built.nodes for _, built in whole)
        yield (
            f"nodes of {groups} groups merged ÷ one agent's",
            "67.57 %" if is_main else "–",
            "≤ 85 % (A), ≤ 110 % (C)" if is_main else "–",
            "≤ 65 %" if is_main else "",
            f"{share(merged / agents)} ({merged} of {agents})",
        )
        if is_main and all(pairwise):
            tree = sum(built.pairs[-1][1].nodes for _, built in whole)
            yield (
                "the same, merged as a pairwise tree: nodes", "–", "printed", "",
                f"{share(tree / agents)} ({tree} of {agents})",
            )  # fmt: skip
        yield from _compared(
            arm, f"route not localised, {groups} groups merged against one agent",
            "21.97 against 32.03 %" if is_main else "–", "not worse" if is_main else "–",
            merged_name(groups, groups - 1), SINGLE, "better" if is_main else "",
        )  # fmt: skip
    if main > 2:
        pairs = pair_merges(main)[-1].name
        yield from _compared(
            arm, "route not localised, pairwise tree against one agent", "–", "printed", pairs,
            SINGLE,
        )  # fmt: skip


def _whole(arm: ArmResult, groups: int) -> list[tuple[FoldResult, Parallel]]:
    """Folds in which both ways of building are complete."""
    found = [(fold, fold.parallel(groups)) for fold in arm.folds if fold.single() is not None]
    return [(fold, built) for fold, built in found if built is not None]


def _folds(count: int) -> str:
    return "1 fold" if count == 1 else f"{count} folds"


def _ratio(above: Sequence[Time], below: Sequence[Time]) -> str:
    """By counts, wall time beside it."""
    a, b = total(above), total(below)
    return (
        f"{_share(a.counted_s, b.counted_s)} by counts, {_share(a.wall_s, b.wall_s)} by the clock"
    )


def _share(part: float | None, whole: float | None) -> str:
    """One by the other; a dash where either was not measured, or nothing was counted."""
    return "–" if part is None or not whole else share(part / whole)


def _sharing(arm: ArmResult) -> Iterator[Row]:
    """Fig. 8."""
    for robot in ROBOTS:
        yield from _compared(
            arm, f"held-out drives in the shared map against {robot}'s own", "better",
            "better, interval clear of 0", SHARED, robot,
        )  # fmt: skip


def _compared(
    arm: ArmResult, what: str, paper: str, must: str, a: str, b: str, aim: str = ""
) -> Iterator[Row]:
    found = arm.held_out(a, b)
    if found is None:
        return
    ours, theirs = found
    resamples = Resamples.of(len(ours.sessions), seed=arm.plan.options.seed)
    tail = "; ".join(
        f"P(> {at:g} m) {share(ours.failure(at).value)} against {share(theirs.failure(at).value)}"
        for at in (5.0, 10.0)
    )
    measured = against(resamples, ours.not_localised, theirs.not_localised)
    yield what, paper, must, aim, f"{measured}; {tail}; {len(ours.sessions)} drives"


def _downloads(arm: ArmResult) -> Iterator[Row]:
    """Fig. 9."""
    yield from _forays(arm)
    trials = arm.trials()
    if COPY not in trials:
        return
    for name in (TOD, TOD_PATHS, QUARTER, TENTH):
        pairs = _paired(trials, name, COPY)
        if pairs:
            yield from _against_copy(arm, name, pairs)
    for budget, other in ((AS_TOD, TOD), (AS_TOD_PATHS, TOD_PATHS)):
        pairs = _paired(trials, budget, other)
        if pairs:
            yield (
                f"`budget` of the bytes of `{other}` against it, route not localised",
                "–",
                "better",
                "",
                _difference(arm, pairs),
            )


Pairs: TypeAlias = list[tuple[TriedDownload, TriedDownload]]


def _paired(trials: Trials, a: str, b: str) -> Pairs:
    """Trials of the same drives in two kinds of download."""
    others = {drive.session.id: one for drive, one in trials.get(b, [])}
    return [
        (one, others[drive.session.id])
        for drive, one in trials.get(a, [])
        if drive.session.id in others
    ]


def _against_copy(arm: ArmResult, name: str, pairs: Pairs) -> Iterator[Row]:
    nodes = float(np.mean([one.nodes / one.of_nodes for one, _ in pairs]))
    united = float(np.mean([one.united / one.of_nodes for one, _ in pairs]))
    size = float(np.mean([one.size_bytes / whole.size_bytes for one, whole in pairs]))
    if name in _MUST_NODES:
        yield (
            f"`{name}`: nodes of the server's",
            _PAPER_NODES[name],
            _MUST_NODES[name],
            "",
            f"{share(nodes)}; united with the robot's own {share(united)}; bytes {share(size)}",
        )
    promised = _weighted([one for one, _ in pairs])
    yield (
        f"`{name}` against `copy`, route not localised",
        "–",
        _MUST_POINTS[name],
        _AIM_POINTS.get(name, ""),
        f"{_difference(arm, pairs)}; promised {share(promised)}; bytes {share(size)}",
    )
    if name in _MUST_NODES:
        ms, asked, query, dense = (
            [float(np.mean([getattr(pair[k], what) for pair in pairs])) for k in (0, 1)]
            for what in ("ms", "lookup_ms", "query_ms", "dense_ms")
        )
        yield (
            f"mean ms per localisation, relocalisation included: `{name}` against `copy`",
            "less",
            "less",
            "",
            f"{ms[0]:.2f} against {ms[1]:.2f} ms (of that look-ups {asked[0]:.3f} and "
            f"{asked[1]:.3f}); one FAB-MAP query {query[0]:.3f} against {query[1]:.3f} ms by the "
            f"inverted index, {dense[0]:.2f} against {dense[1]:.2f} ms by a dense table",
        )


def _weighted(trials: Sequence[TriedDownload]) -> float:
    lengths = np.array([one.drive.step_m.sum() for one in trials])
    return float(np.array([one.expected_missed for one in trials]) @ lengths / lengths.sum())


def _difference(arm: ArmResult, pairs: Pairs) -> str:
    a, b = (not_localised_sums([one[k].drive for one in pairs]) for k in (0, 1))
    resamples = Resamples.of(len(pairs), seed=arm.plan.options.seed)
    return f"{against(resamples, a, b)}; {len(pairs)} drives"


def _forays(arm: ArmResult) -> Iterator[Row]:
    """The robots' second forays in what they took along."""
    copied = arm.forays(COPY)
    for policy in (TOD, TOD_PATHS):
        driven, taken = arm.forays(policy), arm.downloads(policy)
        if not driven or len(driven) != len(copied):
            continue
        whole = sum(one.of_nodes for one in taken)
        a, b = (not_localised_sums([one.drive for one in some]) for some in (driven, copied))
        resamples = Resamples.of(len(driven), seed=arm.plan.options.seed)
        sent, united = sum(one.nodes for one in taken), sum(one.united for one in taken)
        yield (
            f"second foray in one `{policy}` download, made for its first drive: nodes taken along",
            _PAPER_NODES[policy],
            "–",
            "",
            f"{share(sent / whole)}; united with the robot's own {share(united / whole)}"
            + _asked_for_more(taken, policy),
        )
        yield (
            f"route not localised in that foray, `{policy}` against `copy`",
            "slightly worse",
            "–",
            "",
            f"{against(resamples, a, b)}; {_ms(driven)} against {_ms(copied)} ms a frame",
        )


def _asked_for_more(taken: Sequence[DownloadRecord], policy: str) -> str:
    """Of the robots that could not get what they wanted."""
    others = [one.policy for one in taken if one.policy != policy]
    if not others:
        return ""
    words = ", ".join(f"{others.count(one)} `{one}`" for one in sorted(set(others)))
    return f" ({words} among {len(taken)}: nothing had been driven at that hour)"


def _ms(forays: Sequence[InField]) -> str:
    return f"{float(np.mean([one.ms for one in forays])):.2f}"


def _orders(arm: ArmResult) -> Iterator[Row]:
    """Fig. 10."""
    fold = arm.folds[0]
    found = fold.orders()
    if found is None:
        return
    by_model, by_tree, checked = _order_times(fold, found)
    yield (
        f"{len(found['orders'])} orders of {len(fold.order_groups())} groups by (8), against "
        "sequential ones",
        "22.44 %",
        "≤ 30 %",
        "≤ 20 %",
        by_model,
    )
    yield "the same against a sequential prefix tree", "–", "printed", "", by_tree
    if fold.sequential() is not None:
        yield (
            "one order really built sequentially: time of its later groups ÷ (k − 1)·T_G of (8)",
            "100 % (assumed)",
            "checked",
            "",
            checked,
        )
    yield from _spread(found)
    yield from _chosen_against_sequential(fold, found)


def _order_times(fold: FoldResult, found: dict[str, Any]) -> tuple[str, str, str]:
    """By (8), against a prefix tree, and one order really built; dashes for what is not timed."""
    groups = fold.order_groups()
    groups_s = total(fold.time_of(one) for one in groups).counted_s
    merges_s = fold.counted(
        Counts(found["replayed"], found["attempts"], found["proposed"], found["lookups"])
    )
    if groups_s is None or merges_s is None:
        return "–", "–", "–"
    group_s, merge_s = groups_s / len(groups), merges_s / max(found["merges"], 1)
    copy_s = found["copy_s"] / max(found["copies"], 1)
    costs = order_costs(len(groups), group_s, merge_s, copy_s)
    built = fold.sequential()
    rest_s = fold.time_of(built[len(groups[0]) :]).counted_s if built else None
    return (
        f"{_share(costs.model_s, costs.sequential_s)}; as a prefix tree "
        f"{_share(costs.tree_s, costs.sequential_s)} (T_G {group_s:.1f} s, T_M {merge_s:.2f} s by "
        f"counts, T_C {copy_s:.2f} s)",
        _share(costs.tree_s, costs.sequential_tree_s),
        _share(rest_s, (len(groups) - 1) * group_s),
    )


def _spread(found: dict[str, Any]) -> Iterator[Row]:
    curves = np.array([one["reported"] for one in found["orders"]])
    for at in (5, 10, 20):
        values = curves[:, 2 * at]
        least, median, most = (share(float(of(values))) for of in (np.min, np.median, np.max))
        yield (
            f"P(> {at} m) over the orders, held-out drives: least, median, most; chosen order",
            "orders differ",
            "printed",
            "",
            f"{least}, {median}, {most}; {share(values[0])}",
        )


def _chosen_against_sequential(fold: FoldResult, found: dict[str, Any]) -> Iterator[Row]:
    """What choosing gains over one agent that mapped the groups' drives one after another."""
    built, chosen = fold.sequential(), found["orders"][0]
    driven = fold.held_out("orders-sequential")
    if built and driven:
        missed = route_not_localised([one.drive for one in driven])
        yield (
            "chosen order against one agent with the same drives: route not localised; nodes",
            "–",
            "printed",
            "",
            f"{share(chosen['reported_missed'])} against {share(missed)}; "
            f"{chosen['nodes']} against {built[-1].nodes}",
        )


_COLUMNS = CLAIM_COLUMNS[:-1]
_TABLES: dict[int, tuple[str, Callable[[ArmResult], Iterator[Row]]]] = {
    7: ("Building side by side", _building),
    8: ("Sharing", _sharing),
    9: ("Taking a part", _downloads),
    10: ("Orders of merging", _orders),
}
