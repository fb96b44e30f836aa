"""[L15]'s experiments on our data, from per-frame results to tables, a page and Figs. 9 to 13."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram.cli.settings import AllSettings
from engram.errors import InputError
from engram.measures import FORMULAS, Drive, Estimator, failure_sums, longest_gap_m
from engram.robot.settings import Settings
from engram_lab.accuracy import PoseErrors
from engram_lab.charts import COLOURS, Line, Panel, draw_bars, draw_curves
from engram_lab.intervals import (
    Interval,
    Resamples,
    SessionSums,
    difference,
    excess_ratio,
    not_localised_sums,
    ratio,
)
from engram_lab.policies import STUDIED
from engram_lab.studies.building import BuiltMap
from engram_lab.studies.configurations import (
    BY_TRUTH,
    EVERYTHING,
    PATH_POLICIES,
    UNLIMITED,
    Configuration,
    PathKinds,
    Radius,
    lanes_text,
)
from engram_lab.studies.drives import Fold
from engram_lab.studies.in_force import (
    OF_DRIVE,
    VARIED,
    Values,
    columns,
    common,
    exceptions,
    in_words,
    unused,
)
from engram_lab.studies.in_force import rows as in_force_rows
from engram_lab.studies.lockstep import Runs, read_runs
from engram_lab.studies.plan import (
    COMPARED,
    Row,
    chosen,
    compared,
    failure_line,
    make_folder,
    pivot,
    plain_table,
    rated,
    row_line,
    table,
    write_study,
)
from engram_lab.studies.running import Plan, built_map
from engram_lab.truth import TRUTH_SUFFIX

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SessionResult:
    """One held-out session under one configuration.

    Attributes:
        name: of the drive, for people.
    """

    session: int
    fold: int
    nodes: int
    drive: Drive
    attempts: int
    candidates: float
    succeeded: float
    near: int
    near_seen: int
    errors: PoseErrors
    step_ms: float
    in_force: Values
    name: str = ""

    @property
    def frames(self) -> int:
        """Live frames."""
        return len(self.drive.matched)


class ConfigurationResult:
    """All held-out sessions under one configuration, in the order of time."""

    def __init__(self, configuration: Configuration, sessions: Sequence[SessionResult]) -> None:
        self.configuration = configuration
        self.sessions = tuple(sorted(sessions, key=lambda one: one.session))

    @cached_property
    def in_force(self) -> Values:
        """What the sessions were localised by."""
        return common(one.in_force for one in self.sessions)

    @property
    def drives(self) -> list[Drive]:
        """For the measures."""
        return [one.drive for one in self.sessions]

    @cached_property
    def not_localised(self) -> SessionSums:
        """Route not localised: metres of steps without a match ÷ metres (method §8)."""
        return not_localised_sums(self.drives)

    @cached_property
    def driven_m(self) -> Array:
        """(S,) odometry distance of each session."""
        return np.array([float(one.step_m.sum()) for one in self.drives])

    def failure(self, at_m: float, estimator: Estimator = Estimator.ROUTE) -> SessionSums:
        """P(X ≥ x) at one distance."""
        parts = [failure_sums(one, np.array([at_m]), estimator) for one in self.drives]
        return SessionSums(np.array([p[0][0] for p in parts]), np.array([p[1] for p in parts]))

    @property
    def attempts_per_frame(self) -> float:
        """Match attempts ÷ frames."""
        return _over(sum(one.attempts for one in self.sessions), self.frames)

    @property
    def frames(self) -> int:
        """Of all sessions."""
        return sum(one.frames for one in self.sessions)

    @property
    def successes(self) -> int:
        """Frames that were localised."""
        return sum(int(one.drive.matched.sum()) for one in self.sessions)

    @property
    def errors(self) -> PoseErrors:
        """Of all successes with known truth."""
        return PoseErrors(
            np.concatenate([one.errors.offset_m for one in self.sessions]),
            np.concatenate([one.errors.turn_rad for one in self.sessions]),
        )

    @property
    def false_successes(self) -> int | None:
        """Successes more than 1 m or 5° off; None where truth is not known."""
        errors = self.errors
        return int(errors.false.sum()) if len(errors.offset_m) else None

    @property
    def step_ms(self) -> float:
        """Mean time of a frame."""
        return _over(sum(one.step_ms * one.frames for one in self.sessions), self.frames)

    @property
    def longest_gap_m(self) -> float:
        """The longest distance without a match."""
        return longest_gap_m(self.drives)

    def of_fold(self, fold: int) -> ConfigurationResult:
        """Only the sessions held out in one fold."""
        return self.where(lambda one: one.fold == fold)

    def where(self, chosen: Callable[[SessionResult], bool]) -> ConfigurationResult:
        """Only some of the sessions."""
        return ConfigurationResult(self.configuration, list(filter(chosen, self.sessions)))


@dataclass(frozen=True, eq=False)  # no slots: it remembers its draws
class CampaignResult:
    """All results of one campaign.

    Attributes:
        relocaliser: what found the lost; None for nothing.
        lap: per-frame candidates and possible successes of one session ([L15] Fig. 10); None
            where that was not run.
        left_out: configurations that were not run on the same sessions as most, with on how many;
            they are in no table.
    """

    name: str
    memo: Mapping[Configuration, ConfigurationResult]
    live: Mapping[Configuration, ConfigurationResult]
    with_truth: bool
    seed: int
    few_lanes: int
    rounds: int
    relocaliser: str | None
    lap: Lap | None
    left_out: Mapping[Configuration, int]
    tables: AllSettings
    maps_in_force: Values

    @property
    def T(self) -> int:  # noqa: N802 - the paper's letter
        """Iterations remembered where a configuration does not say otherwise."""
        return self.tables.localiser.recent.T

    def T_of(self, configuration: Configuration) -> int:  # noqa: N802 - the paper's letter
        """Iterations that a configuration asks for."""
        return self.T if configuration.T is None else configuration.T

    @property
    def paths(self) -> PathKinds:
        """Entries that count where a configuration does not say otherwise."""
        return PathKinds.of(self.tables.localiser)

    def in_force(self, mode: str = "memo") -> Values:
        """What all configurations without a variant were localised by; each adds its budget."""
        results = self.memo if mode == "memo" else self.live
        plain = (one for one in results.values() if one.configuration.is_plain)
        known = common(one.in_force for one in plain)
        return {key: value for key, value in known.items() if key not in VARIED}

    @cached_property
    def resamples(self) -> Resamples:
        """The same draws of sessions for everything, so that comparisons are paired."""
        sessions = max((len(one.sessions) for one in self.memo.values()), default=1)
        return Resamples.of(max(sessions, 1), seed=self.seed)

    def get(
        self, policy: str, lanes: int | None = None, **other: Any
    ) -> ConfigurationResult | None:
        """The result of a configuration; None where it was not run."""
        one = Configuration(policy, lanes or self.few_lanes, **{"rounds": self.rounds, **other})
        return self.memo.get(one)

    @property
    def policies(self) -> list[str]:
        """Those run, in the order of `STUDIED`, then others by name, whichever came first."""
        run = {one.policy for one in self.memo}
        return [name for name in STUDIED if name in run] + sorted(run - set(STUDIED))


@dataclass(frozen=True, slots=True, eq=False)
class Lap:
    """One session along its route.

    Attributes:
        driven_m: (F,) from its start.
        candidates: (F,) |Y|.
        succeeded: (F,) candidates that match.
    """

    name: str
    driven_m: Array
    candidates: NDArray[np.int32]
    succeeded: NDArray[np.int32]


# Of each configuration, by number of session.
_Found: TypeAlias = dict[Configuration, dict[int, SessionResult]]


def collect(plan: Plan) -> CampaignResult:
    """Reads what was run of a plan; what the folder holds beyond what the plan asks is left out.

    So is, while a plan is not done, what was not run in all sessions that were begun: every table
    compares configurations on the same sessions. `CampaignResult.left_out` tells of it.
    """
    options = plan.options
    wanted = {
        one
        for fold in plan.run_folds
        for one in options.wanted(len(fold.training), plan.settings.localiser)
    }
    by_mode: dict[str, _Found] = {"memo": {}, "live": {}}
    laps: list[Lap] = []
    maps: list[Values] = []
    for fold in plan.run_folds:
        built = built_map(plan, fold)
        maps.append(built.in_force)
        for session in fold.held_out:
            for mode, found in by_mode.items():
                runs = read_runs(plan.runs_path(session, mode))
                if runs is None:
                    continue
                for row, one in enumerate(runs.configurations):
                    if one not in wanted:
                        continue
                    nodes = _nodes(built, fold, one)
                    result = replace(
                        session_result(runs, row, session, fold.number, nodes),
                        name=plan.drives.drives[session].name,
                    )
                    found.setdefault(one, {})[session] = result
                if mode == "memo":
                    laps += _lap(runs, plan.drives.drives[session].name)
    begun = by_mode["memo"]
    # Guided runs are of some folds only, and a policy may be run in one more: what most have.
    memo = _on_same(begun, lambda sessions, having: (len(sessions), having))
    live = _on_same(by_mode["live"], lambda sessions, having: (having, len(sessions)))
    # Where folds differ in size, the largest maps of some have no counterpart in the others.
    least = min(len(fold.training) for fold in plan.run_folds)
    comparable = [one for one in begun if one.sessions is None or one.sessions < least]
    return CampaignResult(
        plan.drives.name,
        memo,
        live,
        plan.drives.has_truth,
        options.seed,
        options.few_lanes,
        options.rounds[0],
        options.relocaliser,
        _ordinary(laps),
        {one: len(begun[one]) for one in comparable if one not in memo},
        plan.tables,
        common(maps),
    )


def _on_same(
    found: _Found, worth: Callable[[frozenset[int], int], tuple[int, int]]
) -> dict[Configuration, ConfigurationResult]:
    """The configurations that were run on the same sessions, on those: others cannot be compared.

    Which sessions, `worth` says, of a set of them and of how many configurations have them all.
    """
    sets = Counter(frozenset(by_session) for by_session in found.values())

    def of(sessions: frozenset[int]) -> tuple[tuple[int, int], list[int]]:
        having = sum(count for other, count in sets.items() if sessions <= other)
        return worth(sessions, having), sorted(sessions, reverse=True)

    common = max(sets, key=of, default=frozenset[int]())
    return {
        one: ConfigurationResult(one, [by_session[k] for k in by_session if k in common])
        for one, by_session in found.items()
        if common <= by_session.keys()
    }


def _nodes(built: BuiltMap, fold: Fold, one: Configuration) -> int:
    """Nodes of the map that a configuration was run in."""
    count = len(fold.training) if one.sessions is None else one.sessions
    if count > len(built.sessions):
        raise InputError(
            f"{built.path.with_suffix('.json')} has {len(built.sessions)} sessions, and there "
            f"are results in a map of {count}; give the command again without --report-only"
        )
    return built.sessions[count - 1].nodes


def session_result(runs: Runs, row: int, session: int, fold: int, nodes: int) -> SessionResult:
    """One configuration's row of what was run of a session."""
    known = np.isfinite(runs.offset_m[row])
    return SessionResult(
        session=session,
        fold=fold,
        nodes=nodes,
        drive=Drive(runs.step_m, runs.matched[row].copy()),
        attempts=int(runs.attempts[row].sum()),
        candidates=float(runs.candidates[row].mean()),
        succeeded=float(runs.succeeded[row].mean()),
        near=int(runs.near[row].sum()),
        near_seen=int(runs.near_seen[row].sum()),
        errors=PoseErrors(
            runs.offset_m[row][known].astype(np.float64),
            runs.turn_rad[row][known].astype(np.float64),
        ),
        step_ms=float(runs.step_ms[row]),
        in_force=runs.in_force[row],
    )


def _lap(runs: Runs, name: str) -> list[Lap]:
    """From the run that attempted every candidate; empty where there is none."""
    if EVERYTHING not in runs.configurations:
        return []
    row = runs.configurations.index(EVERYTHING)
    return [Lap(name, np.cumsum(runs.step_m), runs.candidates[row], runs.succeeded[row])]


def _ordinary(laps: Sequence[Lap]) -> Lap | None:
    """That which is neither easy nor hard: the median, by how many candidates match."""
    by_matches = sorted(laps, key=lambda one: (float(one.succeeded.mean()), one.name))
    return by_matches[len(laps) // 2] if laps else None


def _over(above: float, below: float) -> float:
    return above / below if below else 0.0


_AT_M = (5.0, 10.0)
_ESTIMATORS = (Estimator.ROUTE, Estimator.GAP, Estimator.LOST)
_USUAL = {"mode": "memo", "fold": "all"}


def summary_rows(campaign: CampaignResult) -> list[Row]:
    """One row per configuration and fold, and one of all folds pooled, with 90 % intervals."""
    rows = []
    for mode, results in (("memo", campaign.memo), ("live", campaign.live)):
        for result in results.values():
            rows += [
                _row(campaign, mode, result.of_fold(fold), str(fold))
                for fold in sorted({one.fold for one in result.sessions})
            ]
            pooled = _row(campaign, mode, result, "all")
            rows.append(pooled | _intervals(campaign, result))
            if mode == "memo":
                rows[-1] |= _beside_others(campaign, result)
    return rows


def session_rows(campaign: CampaignResult) -> list[Row]:
    """One row per configuration and session, in the whole map."""
    return [
        {
            "session": session.session,
            "drive": session.name,
            **_row(
                campaign,
                mode,
                ConfigurationResult(result.configuration, [session]),
                str(session.fold),
            ),
        }
        for mode, results in (("memo", campaign.memo), ("live", campaign.live))
        for result in results.values()
        if result.configuration.sessions is None
        for session in result.sessions
    ]


def _row(campaign: CampaignResult, mode: str, result: ConfigurationResult, fold: str) -> Row:
    configuration, errors = result.configuration, result.errors
    known = len(errors.offset_m) > 0
    return {
        "campaign": campaign.name,
        "policy": configuration.policy,
        "lanes": configuration.lanes_text,
        "rounds": configuration.rounds,
        "T": campaign.T_of(configuration),
        "radius": configuration.radius.value,
        "paths": (configuration.paths or campaign.paths).value,
        "map_sessions": configuration.sessions,
        "mode": mode,
        "fold": fold,
        "sessions": len(result.sessions),
        "frames": result.frames,
        "driven_m": float(result.driven_m.sum()),
        "p_gt_10m": result.failure(10.0).value,
        "share_not_localised": result.not_localised.value,
        "attempts_per_frame": result.attempts_per_frame,
        "ms_per_frame": result.step_ms if mode == "live" else None,
        "false_successes": result.false_successes,
        "median_error_m": float(np.median(errors.offset_m)) if known else None,
        "median_error_deg": float(np.rad2deg(np.median(errors.turn_rad))) if known else None,
        "successes": result.successes,
        "p_gt_5m": result.failure(5.0).value,
        **{
            f"p_gt_{at_m:.0f}m_{estimator.value}": result.failure(at_m, estimator).value
            for estimator in (Estimator.GAP, Estimator.LOST)
            for at_m in _AT_M
        },
        "longest_gap_m": result.longest_gap_m,
        "candidates_per_frame": float(np.mean([one.candidates for one in result.sessions])),
        "nodes": float(np.mean([one.nodes for one in result.sessions])),
        "step_ms_without_matching": result.step_ms if mode == "memo" else None,
        **{name: value for name, value in columns(result.in_force).items() if name != "T"},
    }


def _intervals(campaign: CampaignResult, result: ConfigurationResult) -> Row:
    resamples = Resamples.of(len(result.sessions), seed=campaign.seed)
    found: Row = {}
    for name, sums in (
        ("p_gt_10m", result.failure(10.0)),
        ("share_not_localised", result.not_localised),
    ):
        interval = resamples.interval(sums)
        found |= {f"{name}_low": interval.low, f"{name}_high": interval.high}
    return found


def _beside_others(campaign: CampaignResult, result: ConfigurationResult) -> Row:
    """Excess over the oracle, and the paired difference from `distance`, under the same budget."""
    mine = result.configuration
    plain = Configuration("oracle", mine.lanes, mine.rounds, sessions=mine.sessions)
    bound = campaign.memo.get(plain)
    nearest = campaign.memo.get(replace(plain, policy="distance"))
    row: Row = {}
    if bound is not None:
        row["excess_not_localised"] = result.not_localised.value - bound.not_localised.value
        row["excess_p_gt_10m"] = result.failure(10.0).value - bound.failure(10.0).value
    if nearest is not None:
        gap = campaign.resamples.interval(difference(result.not_localised, nearest.not_localised))
        row["minus_distance"] = gap.estimate
        row |= {"minus_distance_low": gap.low, "minus_distance_high": gap.high}
    return row


# Names of simulated drives say the weather; a road is wet in these.
_WET = re.compile(r"-(rain|showers|damp|thaw)-")


def is_wet(drive: str) -> bool:
    """Whether a simulated drive's road is wet, by its name."""
    return bool(_WET.search(drive))


_MEASURES = {
    "policy": "policy",
    "drives": "drives",
    **{f"p_gt_10m_{one.value}": f"P(> 10 m), {one.value}" for one in _ESTIMATORS},
    "share_not_localised": "route not localised",
}


def measure_rows(campaign: CampaignResult) -> list[Row]:
    """Every estimator of P(> 10 m) at the few lanes, on dry and on wet roads apart."""
    kinds: list[tuple[str, Callable[[SessionResult], bool]]] = [
        ("dry", lambda one: not is_wet(one.name)),
        ("wet", lambda one: is_wet(one.name)),
    ]
    rows = []
    for policy in campaign.policies:
        result = campaign.get(policy)
        for kind, chosen_ones in kinds if result is not None else ():
            assert result is not None
            some = result.where(chosen_ones)
            if some.sessions:
                shares = {
                    f"p_gt_10m_{one.value}": some.failure(10.0, one).value for one in _ESTIMATORS
                }
                missed = some.not_localised.value
                row = {"policy": policy, "drives": f"{len(some.sessions)} {kind}"}
                rows.append({**row, **shares, "share_not_localised": missed})
    return rows


def few_lanes_results(campaign: CampaignResult) -> list[ConfigurationResult]:
    """Every policy, and the variants of the path policies."""
    found = [campaign.get(policy) for policy in campaign.policies]
    found += [
        campaign.get(policy, **variant)
        for policy in PATH_POLICIES
        for variant in ({"radius": Radius.BASIN}, {"paths": campaign.paths.other})
    ]
    return [one for one in found if one is not None]


def labelled(campaign: CampaignResult, rows: Sequence[Row]) -> list[Row]:
    """The memoised rows of all folds, by what is unusual about them."""
    labels = {
        (one.policy, one.radius.value, (one.paths or campaign.paths).value): one.label
        for one in campaign.memo
    }
    return [
        {**row, "label": labels[row["policy"], row["radius"], row["paths"]]}
        for row in chosen(rows, campaign=campaign.name, **_USUAL)
    ]


def policy_rows(campaign: CampaignResult, own: Sequence[Row]) -> list[Row]:
    """All policies at the few lanes, losers too."""
    timed = {one.policy: result.step_ms for one, result in campaign.live.items()}
    rows = []
    for result in few_lanes_results(campaign):
        one = result.configuration
        (row,) = chosen(
            own, label=one.label, lanes=one.lanes_text, rounds=one.rounds, T=campaign.T,
            map_sessions=None,
        )  # fmt: skip
        ms = timed.get(one.policy) if one.label == one.policy else None
        rows.append({**row, "ms_as_on_a_robot": ms, "beats_distance": _verdict(row)})
    return rows


_VERDICTS = {True: "yes", False: "no", None: "no difference shown"}


def _verdict(row: Row) -> str:
    """Whether a policy misses less of the route than `distance` (method §8)."""
    if row["label"] == "distance" or "minus_distance" not in row:
        return ""
    gap = Interval(*(row[f"minus_distance{end}"] for end in ("", "_low", "_high")))
    return _VERDICTS[gap.lower]


def rows_by_size(campaign: CampaignResult, own: Sequence[Row]) -> list[Row]:
    """The rows at the few lanes, by the number of sessions in the map ([L15] Fig. 9)."""
    few = chosen(
        own, lanes=lanes_text(campaign.few_lanes), rounds=campaign.rounds, T=campaign.T,
        radius="search", paths=campaign.paths.value,
    )  # fmt: skip
    return sorted(few, key=lambda row: row["map_sessions"] or UNLIMITED)


# Unlimited lanes stand one step behind the last number.
_BEYOND = 20.0
# A policy has one colour in all figures, whichever others are drawn beside it.
POLICY_COLOURS = dict(
    zip(
        (
            "distance", "path-near", "path", "random", "oracle", "time-of-day", "bag-of-words",
            "collaborative", "nearest-of-each", "bandit", "recall",
        ),
        COLOURS,
        strict=True,
    )
)  # fmt: skip
_LOOKS = {policy: (colour, "-") for policy, colour in POLICY_COLOURS.items()} | {
    Configuration("path-near", paths=kinds).label: (POLICY_COLOURS["path-near"], "--")
    for kinds in PathKinds
}


def draw_figures(out: Path, campaigns: Sequence[CampaignResult], rows: Sequence[Row]) -> list[Path]:
    """Draws every figure for which results are there; returns the files."""
    written: list[Path] = []
    own = {one.name: labelled(one, rows) for one in campaigns}

    def draw(name: str, panels: Sequence[Panel], title: str) -> None:
        shown = [panel for panel in panels if panel.lines]
        if shown:
            draw_curves(shown, out / name, title, _LOOKS)
            written.append(out / name)

    few = ", ".join(sorted(set(map(_budget, campaigns))))
    rounds = ", ".join(sorted({f"Nr = {one.rounds}" for one in campaigns}))
    memory = ", ".join(sorted({f"T = {one.T}" for one in campaigns}))
    sizes = [_map_size(one, own[one.name]) for one in campaigns]
    draw("fig09_map_size.png", sizes, f"failure as the map grows, {few}")
    draw(
        "fig10_candidates.png", list(map(_lap_panel, campaigns)), "candidates along an ordinary lap"
    )
    for name, column, label in (
        ("lanes", "p_gt_10m", "P(no match for > 10 m), %"),
        ("lanes_not_localised", "share_not_localised", "route not localised, %"),
        ("lanes_against_distance", "minus_distance", "route not localised less distance's, points"),
    ):
        panels = [_lanes(one, own[one.name], column, label) for one in campaigns]
        title = f"failure against the number of lanes, {rounds}, {memory}"
        draw(f"fig11_{name}.png", panels, title)
    for estimator, scaled in (*((one, False) for one in Estimator), (Estimator.LOST, True)):
        name = f"fig12_curves_{estimator.value}{'_scaled' if scaled else ''}.png"
        panels = [_curves(c, twice, estimator, scaled) for twice in (1, 2) for c in campaigns]
        formula = FORMULAS[estimator] + (" · share of route not localised" if scaled else "")
        draw(name, panels, f"failure curves, {rounds}; P(X ≥ x) = {formula}")
    swept = [_sensitivity(one, own[one.name]) for one in campaigns]
    draw("fig13_T.png", swept, f"sensitivity of the path policies to T, {few}")
    for one in campaigns:
        written += _draw_costs(out, one, own[one.name])
    return written


def _budget(campaign: CampaignResult) -> str:
    return f"Np = {lanes_text(campaign.few_lanes)}, Nr = {campaign.rounds}"


def _lines(rows: Sequence[Row], x: str, column: str) -> list[Line]:
    """One line per label that has several points."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row["label"], []).append(row)
    return [
        row_line(label, some, [row[x] for row in some], column)
        for label, some in found.items()
        if len(some) > 1 and all(column in row for row in some)
    ]


def _map_size(campaign: CampaignResult, own: Sequence[Row]) -> Panel:
    """[L15] Fig. 9: P(> 10 m) against nodes, after each training session."""
    lines = _lines(rows_by_size(campaign, own), "nodes", "p_gt_10m")
    # The first map, of one drive, misses ten times as much as the next.
    label = "P(no match for > 10 m), %"
    return Panel(campaign.name, "nodes in the map", label, lines, least_y=0.1)


def _lap_panel(campaign: CampaignResult) -> Panel:
    """[L15] Fig. 10: |Y| and how many of it could succeed, along one lap."""
    lap = campaign.lap
    if lap is None:
        return Panel(campaign.name, "", "", [])
    lines = [
        Line("candidates |Y|", lap.driven_m, lap.candidates.astype(np.float64), marks=False),
        Line("that match", lap.driven_m, lap.succeeded.astype(np.float64), marks=False),
    ]
    return Panel(f"{campaign.name}, {lap.name}", "driven, m", "nodes", lines)


def _lanes(campaign: CampaignResult, own: Sequence[Row], column: str, label: str) -> Panel:
    """[L15] Fig. 11: failure against Np; differences are paired."""
    swept = chosen(own, rounds=campaign.rounds, T=campaign.T, radius="search", map_sessions=None)
    if column == "minus_distance":
        swept = chosen(swept, paths=campaign.paths.value)
    placed = [{**row, "x": _place(row["lanes"])} for row in swept]
    placed.sort(key=lambda row: row["x"])
    lines = [
        replace(one, loose_end=bool(one.x[-1] == _BEYOND)) for one in _lines(placed, "x", column)
    ]
    places = sorted({float(x) for line in lines for x in line.x})
    ticks = [(x, "∞" if x == _BEYOND else f"{x:.0f}") for x in places]
    signed = column == "minus_distance"
    return Panel(campaign.name, "lanes, Np", label, lines, ticks, signed=signed)


def _place(lanes: str) -> float:
    return _BEYOND if lanes == lanes_text(UNLIMITED) else float(lanes)


def _curves(campaign: CampaignResult, twice: int, estimator: Estimator, scaled: bool) -> Panel:
    """[L15] Fig. 12: P(X ≥ x), under the few lanes or twice as many."""
    lanes = twice * campaign.few_lanes
    results = [campaign.get(policy, lanes) for policy in campaign.policies]
    lines = [
        failure_line(
            one.configuration.policy, one.drives, campaign.resamples, estimator, scaled=scaled
        )
        for one in results
        if one is not None
    ]
    title = f"{campaign.name}, Np = {lanes_text(lanes)}"
    return Panel(title, "x, m", "P(X ≥ x), %", lines, least_y=0.01)


def _sensitivity(campaign: CampaignResult, own: Sequence[Row]) -> Panel:
    """[L15] Fig. 13: T."""
    lanes = lanes_text(campaign.few_lanes)
    columns = {"P(> 10 m)": "p_gt_10m", "route not localised": "share_not_localised"}
    lines, ticks = [], dict[float, str]()
    for policy in PATH_POLICIES:
        some = chosen(own, label=policy, lanes=lanes, rounds=campaign.rounds, map_sessions=None)
        some.sort(key=lambda row: row["T"])
        if len(some) < 2:  # it was not run, or with one T
            continue
        places = list(range(len(some)))
        ticks |= {float(x): str(row["T"]) for x, row in zip(places, some, strict=True)}
        lines += [
            row_line(f"{policy}, {label}", some, places, column)
            for label, column in columns.items()
        ]
    return Panel(campaign.name, "T", "%", lines, list(ticks.items()))


def _draw_costs(out: Path, campaign: CampaignResult, own: Sequence[Row]) -> list[Path]:
    """Attempts, time, false successes and pose errors of all policies at the few lanes."""
    rows = [row for row in policy_rows(campaign, own) if row["label"] == row["policy"]]
    if not rows:
        return []
    bars = []
    for title, column, scale in (
        ("attempts per frame", "attempts_per_frame", 1.0),
        ("ms per frame (guided, no memo)", "ms_as_on_a_robot", 1.0),
        ("false successes", "false_successes", 1.0),
        ("median error, cm", "median_error_m", 100.0),
    ):
        known = [(row["policy"], scale * row[column]) for row in rows if row[column] is not None]
        if known:
            bars.append((title, known))
    path = out / f"costs_{campaign.name}.png"
    draw_bars(bars, path, f"{campaign.name}, {_budget(campaign)}")
    return [path]


# Shares as low as this differ by less than anyone would notice: added to both sides of ratios to
# the oracle.
_NEGLIGIBLE = 0.005
_BEST_KNOWN = "recall"
# Tables and settings that make maps and localise held-out drives.
_USED = {one.name for one in fields(Settings)} | set(OF_DRIVE)
# So many map sizes are shown, evenly over those that there are.
_SHOWN_SIZES = 8
_NO_TRUTH = (
    "Not every drive has its truth: no pose errors, no false successes. The truth of NAME.framelog "
    f"is NAME{TRUTH_SUFFIX} next to it, in TUM format."
)
_POLICY_COLUMNS = {
    "label": "policy",
    "p_gt_10m": "P(> 10 m)",
    "p_gt_5m": "P(> 5 m)",
    "share_not_localised": "route not localised",
    "excess_not_localised": "excess over the oracle",
    "longest_gap_m": "longest gap, m",
    "attempts_per_frame": "attempts per frame",
    "ms_as_on_a_robot": "ms per frame",
    "false_successes": "false successes",
    "median_error_m": "median error, m",
    "median_error_deg": "°",
    "beats_distance": "beats distance",
}
# What a terminal shows of them.
_FEW_COLUMNS = ("label", "share_not_localised", "p_gt_10m", "beats_distance")


@dataclass(frozen=True, slots=True)
class Report:
    """What was written of a study."""

    files: list[Path]
    text: str


def write_report(out: Path, plans: Sequence[Plan]) -> Report:
    """Everything that an evaluation of ranking policies leaves in its folder."""
    campaigns = [_with_results(plan) for plan in plans]
    make_folder(out)
    rows = [row for one in campaigns for row in summary_rows(one)]
    comparisons = [row for one in campaigns for row in comparison_rows(one)] + pooled_rows(
        campaigns
    )
    tables = {
        "in_force": [row for one in campaigns for row in _in_force_rows(one)],
        "summary": rows,
        "sessions": [row for one in campaigns for row in session_rows(one)],
        "comparisons": comparisons,
        "maps": [
            row for one, plan in zip(campaigns, plans, strict=True) for row in _map_rows(one, plan)
        ],
    }
    files = write_study(
        out,
        tables,
        _page(campaigns, rows, comparisons),
        [plan.configuration() for plan in plans],
        lambda folder: draw_figures(folder, campaigns, rows),
    )
    return Report(files, "\n".join(line for one in campaigns for line in _in_short(one, rows)))


def _in_short(campaign: CampaignResult, rows: Sequence[Row]) -> Iterator[str]:
    few = {name: _POLICY_COLUMNS[name] for name in _FEW_COLUMNS}
    yield from (f"{campaign.name}: {_protocol(campaign)}", "")
    yield from plain_table(policy_rows(campaign, labelled(campaign, rows)), few)
    yield ""


def _with_results(plan: Plan) -> CampaignResult:
    found = collect(plan)
    if not found.memo and not found.live:
        raise InputError(
            f"of {plan.drives.name} nothing was run with these options in {plan.work}; give "
            "--work, --folds, --seed and the settings as when it was run, or leave out "
            "--report-only"
        )
    return found


# -- what the paper claims


def comparison_rows(campaign: CampaignResult) -> list[Row]:
    """Pairs of configurations on the same sessions: shares, differences and ratios."""
    return [{"campaign": campaign.name, **row} for row in _comparisons(campaign)]


def _comparisons(campaign: CampaignResult) -> Iterator[Row]:
    resamples, few = campaign.resamples, campaign.few_lanes

    def pair(
        what: str, a: ConfigurationResult | None, b: ConfigurationResult | None, paper: str = ""
    ) -> Iterator[Row]:
        if a is not None and b is not None and a is not b:
            yield compared(what, a.not_localised, b.not_localised, resamples, paper)

    nearest, bound = (campaign.get(name) for name in ("distance", "oracle"))
    if nearest is not None and bound is not None:
        for result in few_lanes_results(campaign):
            if result.configuration.policy in PATH_POLICIES:
                label = result.configuration.label
                sums = nearest.not_localised, result.not_localised
                excess = excess_ratio(*sums, bound.not_localised)
                what = f"`distance` ÷ `{label}`, Np = {few}"
                paper = "5×" if label == "path" else ""
                yield rated(f"{what}: excess over the oracle", excess, resamples, paper)
                yield rated(f"{what}: route not localised", ratio(*sums), resamples)
                far = ratio(nearest.failure(10.0), result.failure(10.0))
                yield rated(f"{what}: P(> 10 m)", far, resamples)
    for policy in PATH_POLICIES:
        name = f"`{policy}`"
        yield from pair(
            f"{name} at Np = 2 against `distance` at Np = 4",
            campaign.get(policy, 2), campaign.get("distance", 4), "equal",
        )  # fmt: skip
        yield from pair(
            f"{name} against `distance`, Np unlimited",
            campaign.get(policy, UNLIMITED), campaign.get("distance", UNLIMITED), "equal",
        )  # fmt: skip
    for policy in PATH_POLICIES:
        yield from pair(
            f"`{policy}` with T = 0 against T = {campaign.T}",
            campaign.get(policy, T=0), campaign.get(policy), "worse",
        )  # fmt: skip
    ours = campaign.get(_BEST_KNOWN)
    for other in ("path", "path-near", "distance", "bandit"):
        yield from pair(f"`{_BEST_KNOWN}` against `{other}`", ours, campaign.get(other))
    if ours is not None and bound is not None:
        to_bound = ratio(ours.not_localised, bound.not_localised, _NEGLIGIBLE)
        what = f"`{_BEST_KNOWN}` ÷ `oracle`: route not localised, 0.5 % added to both"
        yield rated(what, to_bound, resamples)
    for policy, paper in (("distance", "rises"), ("path", "falls 4×"), (_BEST_KNOWN, "")):
        whole, first = campaign.get(policy), campaign.get(policy, sessions=1)
        if whole is not None and first is not None:
            fall = ratio(first.failure(10.0), whole.failure(10.0))
            what = f"`{policy}`: P(> 10 m) in the smallest map ÷ in the largest (Fig. 9)"
            yield rated(what, fall, resamples, paper)
    everything = campaign.memo.get(EVERYTHING)
    near_by = 0 if everything is None else sum(one.near for one in everything.sessions)
    if everything is not None and near_by:
        seen = sum(one.near_seen for one in everything.sessions)
        what = "nodes truly within 8 m and 60° of a localised robot that are candidates"
        yield {"what": what, "share_a": seen / near_by}
    yield from _as_on_a_robot(campaign)


def _as_on_a_robot(campaign: CampaignResult) -> Iterator[Row]:
    """Guided and unmemoised runs against the memoised, unguided ones of the same sessions."""
    for policy in campaign.policies:
        live = campaign.live.get(Configuration(policy, campaign.few_lanes, campaign.rounds))
        memo = campaign.get(policy)
        if live is not None and memo is not None:
            names = {one.session for one in live.sessions}
            same = [one for one in memo.sessions if one.session in names]
            beside = ConfigurationResult(memo.configuration, same)
            what = f"`{policy}` as on a robot against unguided, {len(same)} sessions"
            resamples = Resamples.of(len(same), seed=campaign.seed)
            yield compared(what, live.not_localised, beside.not_localised, resamples)


def pooled_rows(campaigns: Sequence[CampaignResult]) -> list[Row]:
    """All sessions of several campaigns together: whom our policy beats."""
    rows, ours = [], [one.get(_BEST_KNOWN) for one in campaigns]
    for other in ("path-near", "distance", "bandit"):
        pairs = [
            (a.not_localised, b.not_localised)
            for a, b in zip(ours, (one.get(other) for one in campaigns), strict=True)
            if a is not None and b is not None
        ]
        if len(campaigns) > 1 and len(pairs) == len(campaigns):
            a, b = (_together([pair[side] for pair in pairs]) for side in (0, 1))
            resamples = Resamples.of(len(a.numerator), seed=campaigns[0].seed)
            row = compared(f"`{_BEST_KNOWN}` against `{other}`", a, b, resamples)
            rows.append({"campaign": "pooled", **row})
    return rows


def _map_rows(campaign: CampaignResult, plan: Plan) -> Iterator[Row]:
    """What building each fold's map came to: nodes by what the drives that were mapped missed."""
    some = next(iter(campaign.memo.values()), None)
    if some is None:
        return
    m_per_frame = float(some.driven_m.sum()) / some.frames
    for fold in plan.run_folds:
        mapped = built_map(plan, fold).sessions
        frames = sum(one.frames for one in mapped)
        if not frames:
            continue
        missed = 1 - sum(one.share_localised * one.frames for one in mapped) / frames
        per_m = mapped[-1].nodes / (frames * m_per_frame)
        yield {
            "campaign": campaign.name,
            "fold": fold.number,
            "drives": len(mapped),
            "driven_m": frames * m_per_frame,
            "share_not_localised": missed,
            "nodes": mapped[-1].nodes,
            "nodes_per_m": per_m,
            "nodes_per_m_not_localised": per_m / missed if missed else None,
        }


def _together(sums: Sequence[SessionSums]) -> SessionSums:
    return SessionSums(
        np.concatenate([one.numerator for one in sums]),
        np.concatenate([one.denominator for one in sums]),
    )


# -- the page


def _page(
    campaigns: Sequence[CampaignResult], rows: Sequence[Row], comparisons: Sequence[Row]
) -> Iterator[str]:
    for campaign in campaigns:
        own, beside = labelled(campaign, rows), in_words(campaign.in_force())
        yield from (f"## {campaign.name}", "", *_left_out(campaign), _protocol(campaign), "")
        yield from _exceptions(campaign)
        yield from table(policy_rows(campaign, own), _POLICY_COLUMNS, beside)
        yield from table(measure_rows(campaign), _MEASURES, beside)
        yield from table(chosen(comparisons, campaign=campaign.name), COMPARED, beside)
        for column, title in (
            ("share_not_localised", "Route not localised"),
            ("p_gt_10m", "P(> 10 m)"),
        ):
            swept = [
                {**row, "label": f"{row['label']}, Nr = {row['rounds']}", column: row[column]}
                for row in chosen(own, map_sessions=None, T=campaign.T, radius="search")
            ]
            plain = [
                {k: v for k, v in row.items() if not k.endswith(("_low", "_high"))} for row in swept
            ]
            yield from (f"{title} by the number of lanes", "")
            yield from table(pivot(plain, "label", "lanes", column), beside=beside)
        yield from _sizes(campaign, own, beside)
        if not campaign.with_truth:
            yield from (_NO_TRUTH, "")
    if pooled := chosen(comparisons, campaign="pooled"):
        beside = "\n".join(dict.fromkeys(in_words(one.in_force()) for one in campaigns))
        yield from ("## All sessions pooled", "", *table(pooled, COMPARED, beside))


def _in_force_rows(campaign: CampaignResult) -> Iterator[Row]:
    """What the maps were made by, and what held-out drives were localised by."""
    runs = {
        "maps": campaign.maps_in_force,
        "held out": campaign.in_force(),
        "held out, as on a robot": campaign.in_force("live"),
    }
    for name, known in runs.items():
        yield from in_force_rows(known, campaign.tables, {"campaign": campaign.name, "of": name})


def _exceptions(campaign: CampaignResult) -> Iterator[str]:
    """What of the settings does not hold."""
    drive, maps = campaign.tables.drive, campaign.maps_in_force
    yield (
        "- Ranking and budget are varied; those of the settings are "
        f"`{drive.ranking}`, Np = {drive.lanes}, Nr = {drive.rounds}."
    )
    if maps:
        policy, lanes, rounds = (maps.get(key) for key in VARIED)
        yield f"- Maps were made with `{policy}`, Np = {lanes}, Nr = {rounds}."
    for line in exceptions(campaign.in_force(), campaign.tables):
        yield f"- Held-out drives, {line}."
    yield from unused(campaign.tables, _USED)
    yield ""


def _protocol(campaign: CampaignResult) -> str:
    count = max((len(one.sessions) for one in campaign.memo.values()), default=0)
    driven = max((one.driven_m.sum() for one in campaign.memo.values()), default=0.0)
    found_again = {None: "no relocalisation", BY_TRUTH: "the lost found by truth"}.get(
        campaign.relocaliser, str(campaign.relocaliser)
    )
    budget = f"Np = {lanes_text(campaign.few_lanes)}, Nr = {campaign.rounds}, T = {campaign.T}"
    return (
        f"{budget}; {count} held-out sessions, {driven / 1e3:.1f} km, unguided, {found_again}; "
        "90 % intervals over sessions"
    )


def _left_out(campaign: CampaignResult) -> list[str]:
    """What was run on some sessions only: tables compare on the same sessions."""
    fewer: dict[str, list[int]] = {}
    for one, sessions in campaign.left_out.items():
        what = f"Np = {one.lanes_text}" if one.sessions is None else "Fig. 9"
        fewer.setdefault(f"{one.label} ({what})", []).append(sessions)
    if not fewer:
        return []
    said = ", ".join(f"{what} on {min(counts)}" for what, counts in fewer.items())
    every = max((len(one.sessions) for one in campaign.memo.values()), default=0)
    return [
        f"Not in these tables, since not run on the same {every} sessions: {said}. The same "
        "command without --only-folds completes them; --only-folds shows the folds that have them.",
        "",
    ]


def _sizes(campaign: CampaignResult, own: Sequence[Row], beside: str) -> Iterator[str]:
    """P(> 10 m) in maps of so many sessions; a share of the sizes that there are."""
    grown = rows_by_size(campaign, own)
    sizes = sorted({row["map_sessions"] for row in grown if row["map_sessions"] is not None})
    if not sizes:
        return
    shown = np.linspace(0, len(sizes) - 1, min(len(sizes), _SHOWN_SIZES)).round().astype(int)
    wanted = {sizes[k] for k in shown} | {None}
    some = [
        {
            "policy": row["policy"],
            "map": f"{row['map_sessions'] or 'all'} ({row['nodes']:.0f})",
            "p_gt_10m": row["p_gt_10m"],
        }
        for row in grown
        if row["map_sessions"] in wanted
    ]
    yield from ("P(> 10 m) as the map grows: sessions in the map (nodes)", "")
    yield from table(pivot(some, "policy", "map", "p_gt_10m"), beside=beside)
