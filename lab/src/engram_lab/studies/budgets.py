"""Where does ranking pay? Policies by experiences at a place, attempts a frame, and processor time.

    engram lab evaluate budgets begbroke24h --only-folds 0

Maps save every drive whole, so that each place has as many experiences as drives were mapped.
Held-out drives are localised in maps of the first 2, 5, 10, … drives with so many attempts a frame,
all at once, and by everything that is near. The measure is P(> 10 m) over the route.

A cell is a number of experiences and of attempts. In each a policy is compared with `distance` on
the same drives: a sign-flip test of the metres further than 10 m behind the last match, corrected
over all cells of the policy by Holm's method. At equal processor time each policy has the most
attempts that fit, by its own time to rank and the mean time of a match.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError
from engram.localiser.settings import LocaliserConfig
from engram.measures import Drive, failure_sums
from engram.robot.settings import Settings
from engram_lab.intervals import LEVEL, Interval, Resamples, SessionSums, difference
from engram_lab.studies.configurations import UNLIMITED, Configuration, lanes_text
from engram_lab.studies.in_force import common, in_words
from engram_lab.studies.lockstep import read_runs
from engram_lab.studies.plan import Row, make_folder, table, write_study
from engram_lab.studies.running import Plan, RankingOptions

Array = NDArray[np.float64]

POLICIES = ("distance", "path", "path-near", "recall")
# Experiences at a place, as far as there are drives; and all that there are.
SIZES = (2, 5, 10, 20, 40, 80)
ATTEMPTS = (1, 2, 4, 8, 16)
BASELINE, OURS = "distance", "recall"
# No match has so many inliers: whatever a drive meets is saved.
_NEVER_SURE = 1_000_000
_FAR_M = 10.0
# Processor times a frame for ranking and attempts, ms.
_TIMES_MS = (0.25, 0.5, 1.0, 2.0, 4.0)
# At most so many flips of signs; all of them where there are fewer.
_FLIPS = 20_000


AnySettings = TypeVar("AnySettings", bound=Settings)


def saving_everything(settings: AnySettings) -> AnySettings:
    """The settings, by which every drive is saved whole."""
    return replace(settings, mapper=replace(settings.mapper, sure_inliers=_NEVER_SURE))


@dataclass(frozen=True, slots=True)
class BudgetOptions(RankingOptions):
    """What the study runs; `lanes` are the attempts a frame, in one round.

    Attributes:
        sizes: drives in the map; more than there are count as all.
    """

    sizes: tuple[int, ...] = SIZES

    def __post_init__(self) -> None:
        RankingOptions.__post_init__(self)
        if not self.sizes or min(self.sizes) < 1:
            raise ConfigError(f"sizes are {self.sizes}, must be whole numbers from 1 on")
        if BASELINE not in self.policies:
            raise ConfigError(f"policies are {self.policies}: {BASELINE} must be one of them")

    def wanted(self, training: int, config: LocaliserConfig) -> tuple[Configuration, ...]:
        """Every policy and budget in every map, and everything that is near."""
        del config
        counts: list[int | None] = [None, *(one for one in self.sizes if one < training)]
        return tuple(
            one
            for count in counts
            for one in (
                Configuration(BASELINE, UNLIMITED, sessions=count),
                *(
                    Configuration(policy, lanes, sessions=count)
                    for policy in self.policies
                    for lanes in self.lanes
                ),
            )
        )


def session_rows(plan: Plan) -> Iterator[Row]:
    """One row for each held-out drive, policy and cell: all that the tables rest on."""
    for fold in plan.run_folds:
        wanted = set(plan.options.wanted(len(fold.training), plan.settings.localiser))
        for session in fold.held_out:
            runs = read_runs(plan.runs_path(session, "memo"))
            if runs is None:
                continue
            for at, one in enumerate(runs.configurations):
                if one not in wanted:
                    continue
                drive = Drive(runs.step_m, runs.matched[at])
                far_m, driven_m = failure_sums(drive, np.array([_FAR_M]))
                whole = one.sessions is None
                yield {
                    "campaign": plan.drives.name,
                    "drive": plan.drives.drives[session].name,
                    "fold": fold.number,
                    "experiences": len(fold.training) if whole else one.sessions,
                    "all": "yes" if whole else "",
                    "policy": one.policy if one.lanes != UNLIMITED else "everything",
                    "attempts": lanes_text(one.lanes),
                    "driven_m": float(driven_m),
                    "far_m": float(far_m[0]),
                    "missed_m": float(runs.step_m[~runs.matched[at]].sum()),
                    "attempts_per_frame": float(runs.attempts[at].mean()),
                    "candidates_per_frame": float(runs.candidates[at].mean()),
                    "rank_ms": float(runs.rank_ms[at]),
                    "attempt_ms": _or_none(float(runs.attempt_ms[at])),
                }


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None


# Experiences for people: where folds differ in size, "all" is one size.
_Cell = tuple[str, str]


def _size(row: Row) -> str:
    return "all" if row["all"] else str(row["experiences"])


def sign_flip_p(gaps: Array, seed: int = 0) -> float:
    """Probability of a sum as far from 0 if each drive's difference had either sign.

    All signs are gone through where there are few drives; else some are drawn.

    Args:
        gaps: (S,) float64, paired differences by drive.
    """
    gaps = gaps[gaps != 0]
    if not len(gaps):
        return 1.0
    exact = 2 ** len(gaps) <= _FLIPS
    if exact:
        bits = np.arange(2 ** len(gaps))[:, None] >> np.arange(len(gaps)) & 1
        signs = 1.0 - 2.0 * bits
    else:
        draws = np.random.default_rng(seed)
        signs = draws.choice([-1.0, 1.0], (_FLIPS, len(gaps)))
    # Sums that are equal but for rounding are as far.
    extreme = np.abs(signs @ gaps) >= abs(gaps.sum()) * (1 - 1e-9)
    return float(extreme.mean() if exact else (1 + extreme.sum()) / (1 + _FLIPS))


def holm(p: Sequence[float]) -> list[float]:
    """p-values corrected for their number. Source: Holm, Scand. J. Statistics 6 (1979)."""
    corrected, worst = [0.0] * len(p), 0.0
    for rank, at in enumerate(np.argsort(p, kind="stable").tolist()):
        worst = max(worst, min(1.0, (len(p) - rank) * p[at]))
        corrected[at] = worst
    return corrected


def _drives_of(rows: Iterable[Row]) -> dict[_Cell, dict[str, dict[str, Row]]]:
    """Rows by experiences and attempts, policy, and drive."""
    found: dict[_Cell, dict[str, dict[str, Row]]] = {}
    for row in rows:
        cell = _size(row), str(row["attempts"])
        found.setdefault(cell, {}).setdefault(row["policy"], {})[row["drive"]] = row
    return found


def _sums(rows: Iterable[Row]) -> SessionSums:
    listed = list(rows)
    return SessionSums(
        np.array([one["far_m"] for one in listed]), np.array([one["driven_m"] for one in listed])
    )


def cell_rows(rows: Sequence[Row], seed: int = 0) -> list[Row]:
    """One row for each cell and policy: P(> 10 m), and the comparison with `distance`."""
    found: list[Row] = []
    for (size, attempts), policies in _drives_of(rows).items():
        for policy, by_drive in policies.items():
            row: Row = {"experiences": size, "attempts": attempts, "policy": policy}
            sums = _sums(by_drive.values())
            resamples = Resamples.of(len(by_drive), seed=seed)
            interval = resamples.interval(sums)
            row |= {"drives": len(by_drive), **_ends("p_gt_10m", interval)}
            nearest = policies.get(BASELINE, {})
            if policy != BASELINE and nearest.keys() == by_drive.keys():
                beside = _sums(nearest[drive] for drive in by_drive)
                row |= _ends("minus_distance", resamples.interval(difference(sums, beside)))
                row["ratio"] = beside.value / sums.value if sums.value > 0 else None
                row["p"] = sign_flip_p(sums.numerator - beside.numerator, seed)
            found.append(row)
    for policy in {row["policy"] for row in found}:
        tested = [row for row in found if row["policy"] == policy and "p" in row]
        for row, p in zip(tested, holm([row["p"] for row in tested]), strict=True):
            row |= {"p_holm": p, "against_distance": _verdict(row["minus_distance"], p)}
    return found


def _ends(name: str, found: Interval) -> Row:
    return {name: found.estimate, f"{name}_low": found.low, f"{name}_high": found.high}


def _verdict(gap: float, p: float) -> str:
    if p > 1 - LEVEL:
        return "no difference shown"
    return "better" if gap < 0 else "worse"


def time_rows(rows: Sequence[Row]) -> list[Row]:
    """P(> 10 m) by experiences and processor time: the most attempts of a policy that fit."""
    known = [row["attempt_ms"] for row in rows if row["attempt_ms"] is not None]
    if not known:
        return []
    attempt_ms = float(np.median(known))
    by_policy: dict[tuple[str, str], list[tuple[float, float, str]]] = {}
    for (size, attempts), policies in _drives_of(rows).items():
        for policy, by_drive in policies.items():
            some = list(by_drive.values())
            cost_ms = float(
                np.median([one["rank_ms"] for one in some])
                + attempt_ms * np.mean([one["attempts_per_frame"] for one in some])
            )
            p = _sums(some).value
            by_policy.setdefault((size, policy), []).append((cost_ms, p, attempts))
    found = []
    for (size, policy), costs in by_policy.items():
        for limit_ms in _TIMES_MS:
            fitting = [one for one in costs if one[0] <= limit_ms]
            if fitting:
                cost_ms, p, attempts = max(fitting)
                found.append(
                    {
                        "experiences": size,
                        "ms": limit_ms,
                        "policy": policy,
                        "attempts": attempts,
                        "cost_ms": cost_ms,
                        "p_gt_10m": p,
                    }
                )
    return found


def in_a_sentence(cells: Sequence[Row]) -> str:
    """From where on ranking pays, and where it costs."""
    tested = [row for row in cells if row["policy"] == OURS and "against_distance" in row]
    better = [row for row in tested if row["against_distance"] == "better"]
    worse = [row for row in tested if row["against_distance"] == "worse"]
    if not better:
        said = f"`{OURS}` is shown to be better than `{BASELINE}` in none of {len(tested)} cells"
    else:
        first = min(better, key=lambda row: (_order(row["experiences"]), _order(row["attempts"])))
        finite = [row for row in better if row["ratio"] is not None]
        best = max(finite, key=lambda row: row["ratio"], default=first)
        said = (
            f"`{OURS}` is better than `{BASELINE}` in {len(better)} of {len(tested)} cells, from "
            f"{first['experiences']} experiences on with {_tries(first)} a frame"
        )
        if best["ratio"] is not None:
            said += (
                f"; the greatest ratio is {best['ratio']:.1f}, with {best['experiences']} of them "
                f"and {_tries(best)}"
            )
    return f"{said}. It is worse in {len(worse)}."


def _tries(row: Row) -> str:
    return f"{row['attempts']} attempt" + ("" if row["attempts"] == "1" else "s")


def in_short(table_of_cells: Path) -> Iterator[str]:
    """A kept table of cells for a page: the sentence, then P(> 10 m) by attempts."""
    numbers = ("p_gt_10m", "minus_distance", "ratio", "p_holm")
    with table_of_cells.open(encoding="utf-8", newline="") as file:
        cells: list[Row] = [
            {
                **{name: value for name, value in row.items() if value},
                **{name: float(row[name]) if row.get(name) else None for name in numbers},
            }
            for row in csv.DictReader(file)
        ]
    few = [row for row in cells if row["policy"] in {BASELINE, "path", OURS}]
    yield from (in_a_sentence(cells), "")
    yield f"P(> 10 m); a star marks a difference from `{BASELINE}` after Holm's correction:"
    yield from ("", *table(_pivot(few, "attempts", marks=True)))


def _pivot(cells: Sequence[Row], across: str, marks: bool) -> list[Row]:
    """Policies and sizes by attempts or by time; a star where Holm's method shows a difference."""
    found: dict[tuple[str, str], Row] = {}
    for row in sorted(cells, key=lambda one: (_order(one["experiences"]), _order(one[across]))):
        key = row["experiences"], row["policy"]
        line = found.setdefault(key, {"experiences": key[0], "policy": key[1]})
        verdict = row.get("against_distance", "") if marks else ""
        mark = {"better": " *", "worse": " (worse *)"}.get(verdict, "")
        line[str(row[across])] = f"{100 * row['p_gt_10m']:.2f} %{mark}"
    # What has fewest columns last: those that come first give a table its order.
    return sorted(found.values(), key=lambda line: (_order(line["experiences"]), -len(line)))


def _order(value: Any) -> float:
    """Numbers as they are, "all" and "unlimited" behind them."""
    return float("inf") if str(value).isalpha() else float(value)


def write_budgets(out: Path, plans: Sequence[Plan]) -> list[Path]:
    """Tables, page and configuration of what was run.

    Raises:
        ConfigError: nothing was.
    """
    rows = [row for plan in plans for row in session_rows(plan)]
    if not rows:
        raise ConfigError("nothing was run of this study yet: leave out --report-only")
    make_folder(out)
    cells, times = cell_rows(rows, plans[0].options.seed), time_rows(rows)
    return write_study(
        out,
        {"sessions": rows, "cells": cells, "times": times},
        _page(plans, rows, cells, times),
        [plan.configuration() for plan in plans],
        lambda _: [],
    )


def _page(
    plans: Sequence[Plan], rows: Sequence[Row], cells: Sequence[Row], times: Sequence[Row]
) -> Iterator[str]:
    drives = {(row["campaign"], row["drive"]): row["driven_m"] for row in rows}
    names = ", ".join(f"`{plan.drives.name}`" for plan in plans)
    yield from ("# Where ranking pays", "", in_a_sentence(cells), "")
    yield (
        f"{names}: {len(drives)} held-out drives, {sum(drives.values()) / 1e3:.1f} km. P(> 10 m); "
        f"a star marks a difference from `{BASELINE}` at {100 * (1 - LEVEL):.0f} % after Holm's "
        "correction over the policy's cells."
    )
    known = common(_in_force(plan) for plan in plans)
    yield from ("", "By attempts a frame:", "")
    yield from table(_pivot(cells, "attempts", marks=True), beside=in_words(known))
    if times:
        yield from ("By processor time of ranking and attempts, ms a frame:", "")
        yield from table(_pivot(times, "ms", marks=False), beside=in_words(known))


def _in_force(plan: Plan) -> dict[str, Any]:
    """What the plan's drives were localised by, as far as all of them agree."""
    several = []
    for fold in plan.run_folds:
        for session in fold.held_out:
            runs = read_runs(plan.runs_path(session, "memo"))
            several += [] if runs is None else list(runs.in_force[:1])
    return common(several)
