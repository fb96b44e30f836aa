"""The table of a fleet study: a row per experiment, arm, fold and map; pooled ones say all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np

from engram.measures import Drive, failure, longest_gap_m, route_m, route_not_localised
from engram_lab.studies.building import BuiltSession
from engram_lab.studies.fleet.experiments import SHARED, SINGLE, merged_name, pair_merges
from engram_lab.studies.fleet.plan import FORAY_POLICIES, ROBOTS
from engram_lab.studies.fleet.results import (
    ArmResult,
    FoldResult,
    InField,
    Time,
    Trials,
    total,
)
from engram_lab.studies.fleet.trials import TriedDownload
from engram_lab.studies.pages import Row
from engram_lab.studies.summary import ConfigurationResult, SessionResult

_AT_M = (5.0, 10.0, 20.0)


def fleet_rows(arm: ArmResult) -> list[Row]:
    """All rows of one arm."""
    rows: list[Row] = []
    for fold in arm.folds:
        rows += _building_rows(fold)
        rows += _sharing_rows(fold)
        rows += _foray_rows(str(fold.fold.number), _forays(fold))
        rows += _trial_rows(str(fold.fold.number), _flat(fold.trials()))
        rows += _order_rows(fold)
    rows += _pooled_rows(arm)
    return _asked(arm, rows)


def session_rows(arm: ArmResult) -> list[Row]:
    """One row per held-out drive in each map and download: what intervals are drawn from."""
    rows: list[Row] = []
    drives = arm.plan.drives.drives
    for fold in arm.folds:
        number = str(fold.fold.number)
        for experiment, what, name in _shown(fold):
            for one in fold.held_out(name):
                about = _row(experiment, number, what) | {"drive": drives[one.session].name}
                rows.append(about | _held_out([one]))
        for drive, trial in chain.from_iterable(fold.trials().values()):
            rows += [{**row, "drive": drive.name} for row in _trial_rows(number, [trial])]
    return _asked(arm, rows)


def _asked(arm: ArmResult, rows: Sequence[Row]) -> list[Row]:
    """Those of the requested experiments, with what they are about."""
    about = {
        "campaign": arm.plan.drives.name,
        "arm": arm.arm.letter,
        "policy": arm.arm.driving.ranking,
        "attempts": arm.configuration.budget.attempts if arm.arm.letter != "C" else "all",
    }
    return [{**about, **row} for row in rows if arm.asked(row["experiment"])]


def _shown(fold: FoldResult) -> Iterator[tuple[int, str, str]]:
    """Experiment, words and name of the maps that held-out drives are localised in."""
    yield 7, SINGLE, SINGLE
    for groups in fold.plan.group_counts(fold.fold):
        yield 7, f"{groups} groups", merged_name(groups, groups - 1)
        yield 7, f"{groups} groups, pairwise", pair_merges(groups)[-1].name
    for name in (*ROBOTS, SHARED):
        yield 8, name, name
    yield 10, "one order built sequentially", "orders-sequential"


def order_rows(arm: ArmResult) -> list[Row]:
    """One row per order of merging."""
    found = arm.folds[0].orders()
    if found is None or not arm.asked(10):
        return []
    return [
        {
            "campaign": arm.plan.drives.name,
            "arm": arm.arm.letter,
            "order": "-".join(map(str, one["order"])),
            "chosen": one["order"] == found["order"],
            "nodes": one["nodes"],
            "validation_area_m": one["area_m"],
            **{f"validation_p_gt_{at}m": p for at, p in one["at_m"].items()},
            **{f"p_gt_{at:g}m": one["reported"][round(2 * at)] for at in _AT_M},
            "share_not_localised": one["reported_missed"],
        }
        for one in found["orders"]
    ]


def _building_rows(fold: FoldResult) -> Iterator[Row]:
    """Fig. 7."""
    number = str(fold.fold.number)
    single = fold.single()
    if single is not None:
        yield {
            **_row(7, number, SINGLE),
            **_mapped(single),
            **_time(fold.time_of(single)),
            **_held_out(fold.held_out(SINGLE)),
        }
    for groups in fold.plan.group_counts(fold.fold):
        built = fold.parallel(groups)
        if built is None:
            continue
        merged, merges = merged_name(groups, groups - 1), total(built.merge_times)
        logs = sum(len(one) for one in built.groups)
        yield {
            **_row(7, number, f"{groups} groups"),
            "logs": logs,
            "nodes": built.nodes,
            **_time(built.time),
            "merges_counted_s": merges.counted_s,
            "merges_wall_s": merges.wall_s,
            **_held_out(fold.held_out(merged)),
        }
        pairwise = built.pairwise_time
        if pairwise is not None:
            name = pair_merges(groups)[-1].name
            yield {
                **_row(7, number, f"{groups} groups, pairwise"),
                "logs": logs,
                "nodes": fold.nodes(name),
                **_time(pairwise),
                **_held_out(fold.held_out(name)),
            }


def _sharing_rows(fold: FoldResult) -> Iterator[Row]:
    """Fig. 8."""
    found = {name: fold.held_out(name) for name in (*ROBOTS, SHARED)}
    if all(found.values()):
        for name, held_out in found.items():
            row = _row(8, str(fold.fold.number), name)
            yield {**row, "nodes": fold.nodes(name), **_held_out(held_out)}


def _forays(fold: FoldResult) -> list[InField]:
    return [one for some in fold.forays().values() for one in some]


def _foray_rows(number: str, forays: Sequence[InField]) -> Iterator[Row]:
    """Fig. 9: second forays in the field."""
    for policy in FORAY_POLICIES:
        some = [one for one in forays if one.policy == policy]
        if not some:
            continue
        frames = sum(one.frames for one in some)
        counted_s = total(one.time for one in some).counted_s
        yield {
            **_row(9, number, f"foray in {policy}"),
            "logs": len(some),
            "nodes": float(np.mean([one.nodes for one in some])),
            "ms_per_frame": sum(one.ms * one.frames for one in some) / frames,
            "counted_ms_per_frame": None if counted_s is None else 1e3 * counted_s / frames,
            **_failure([one.drive for one in some]),
        }


def _flat(trials: Trials) -> list[TriedDownload]:
    return [one for _, one in chain.from_iterable(trials.values())]


def _trial_rows(number: str, trials: Sequence[TriedDownload]) -> Iterator[Row]:
    """Fig. 9: downloads for the hours of held-out drives."""
    for name in dict.fromkeys(one.name for one in trials):
        some = [one for one in trials if one.name == name]
        lengths = np.array([route_m([one.drive]) for one in some])
        promised = np.array([one.expected_missed for one in some])
        yield {
            **_row(9, number, f"held out in {name}"),
            "nodes": float(np.mean([one.nodes for one in some])),
            "share_of_nodes": float(np.mean([one.nodes / one.of_nodes for one in some])),
            "united_share_of_nodes": float(np.mean([one.united / one.of_nodes for one in some])),
            "size_bytes": float(np.mean([one.size_bytes for one in some])),
            "ms_per_frame": float(np.mean([one.ms for one in some])),
            "lookup_ms_per_frame": float(np.mean([one.lookup_ms for one in some])),
            "lookups": sum(one.lookups for one in some),
            "expected_missed": float(promised @ lengths / lengths.sum()),
            **_failure([one.drive for one in some]),
        }


def _order_rows(fold: FoldResult) -> Iterator[Row]:
    """Fig. 10: the spread over the orders, on the sessions that chose nothing."""
    found = fold.orders()
    if found is None:
        return
    number = str(fold.fold.number)
    curves = np.array([one["reported"] for one in found["orders"]])
    missed = np.array([one["reported_missed"] for one in found["orders"]])
    for name, statistic in (("least", np.min), ("median", np.median), ("most", np.max)):
        yield {
            **_row(10, number, f"{name} of {len(curves)} orders"),
            "share_not_localised": float(statistic(missed)),
            **{f"p_gt_{at:g}m": float(statistic(curves[:, round(2 * at)])) for at in _AT_M},
        }
    yield {
        **_row(10, number, "best order, chosen on validation"),
        "nodes": found["orders"][0]["nodes"],
        "share_not_localised": float(missed[0]),
        **{f"p_gt_{at:g}m": float(curves[0, round(2 * at)]) for at in _AT_M},
    }
    built = fold.sequential()
    if built:
        yield {
            **_row(10, number, "one order built sequentially"),
            **_mapped(built),
            **_time(fold.time_of(built)),
            **_held_out(fold.held_out("orders-sequential")),
        }


def _pooled_rows(arm: ArmResult) -> Iterator[Row]:
    groups = arm.plan.options.groups
    pairs = pair_merges(groups)[-1].name
    for experiment, name, what in (
        (7, SINGLE, SINGLE),
        (7, merged_name(groups, groups - 1), f"{groups} groups"),
        (7, pairs, f"{groups} groups, pairwise"),
    ):
        found = arm.held_out(name)
        if found is not None:
            yield {**_row(experiment, "all", what), **_result(found[0])}
    maps = (*ROBOTS, SHARED)
    for name, result in zip(maps, arm.held_out(*maps) or (), strict=False):
        yield {**_row(8, "all", name), **_result(result)}
    yield from _foray_rows("all", [one for policy in FORAY_POLICIES for one in arm.forays(policy)])
    yield from _trial_rows("all", _flat(arm.trials()))


def _row(experiment: int, fold: str, name: str) -> Row:
    return {"experiment": experiment, "fold": fold, "map": name}


def _mapped(sessions: Sequence[BuiltSession]) -> Row:
    return {
        "logs": len(sessions),
        "nodes": sessions[-1].nodes,
        "frames": sum(one.frames for one in sessions),
        "match_attempts": sum(one.attempts for one in sessions),
        "proposed_attempts": sum(one.proposed for one in sessions),
        "lookups": sum(one.lookups for one in sessions),
    }


def _time(time: Time) -> Row:
    return {"counted_s": time.counted_s, "wall_s": time.wall_s}


def _held_out(sessions: Sequence[SessionResult]) -> Row:
    if not sessions:
        return {}
    drives = [one.drive for one in sessions]
    frames = sum(one.frames for one in sessions)
    return {
        **_failure(drives),
        "attempts_per_frame": sum(one.attempts for one in sessions) / frames,
        "false_successes": sum(int(one.errors.false.sum()) for one in sessions),
    }


def _result(found: ConfigurationResult) -> Row:
    return _held_out(found.sessions)


def _failure(drives: Sequence[Drive]) -> Row:
    return {
        "sessions": len(drives),
        "driven_m": route_m(drives),
        "share_not_localised": route_not_localised(drives),
        **{f"p_gt_{at:g}m": float(failure(drives, at)) for at in _AT_M},
        "longest_gap_m": longest_gap_m(drives),
    }
