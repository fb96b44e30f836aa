"""From per-frame results to tables: one row per configuration and fold, one per session."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram.cli.settings import AllSettings
from engram.errors import InputError
from engram.measures import Drive, Estimator, failure_sums, longest_gap_m
from engram_lab.accuracy import PoseErrors
from engram_lab.intervals import Resamples, SessionSums, not_localised_sums
from engram_lab.policies import STUDIED
from engram_lab.studies.building import BuiltMap
from engram_lab.studies.configurations import EVERYTHING, Configuration, PathKinds, map_sizes, sweep
from engram_lab.studies.drives import Fold
from engram_lab.studies.in_force import VARIED, Values, common
from engram_lab.studies.lockstep import Runs, read_runs
from engram_lab.studies.running import Plan, built_map

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SessionResult:
    """One held-out session under one configuration.

    Attributes:
        session: its number in the order of time.
        fold: in which it was held out.
        nodes: of the map that it was localised in.
        drive: steps and matches, from which every measure of failure follows.
        attempts: match attempts made.
        candidates, succeeded: means over frames of |Y| and of the attempts that were accepted.
        near, near_seen: as in `Runs`, summed over frames.
        errors: of the poses of its successes, where truth is known.
        step_ms: mean time of a frame.
        in_force: what it was localised by.
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
        return ConfigurationResult(
            self.configuration, [one for one in self.sessions if one.fold == fold]
        )


@dataclass(frozen=True, eq=False)  # no slots: it remembers its draws
class CampaignResult:
    """All results of one campaign.

    Attributes:
        name: of the campaign.
        memo: unguided, by configuration.
        live: guided and unmemoised, of fewer sessions, by configuration.
        with_truth: whether pose errors are known.
        seed: of the bootstrap.
        few_lanes, rounds: Np and Nr of the figures that show one budget.
        relocaliser: what found the lost; None for nothing.
        lap: per-frame candidates and possible successes of one session ([L15] Fig. 10); None
            where that was not run.
        left_out: configurations that were not run on the same sessions as most, with on how many;
            they are in no table.
        tables: the settings that the study was given.
        maps_in_force: what the maps were made by.
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
        name: of the session.
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
    wanted = set(sweep(*options.swept, plan.settings.localiser))
    for fold in plan.run_folds:
        wanted.update(
            map_sizes(options.policies, options.few_lanes, len(fold.training), options.rounds[0])
        )
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
                    result = session_result(runs, row, session, fold.number, nodes)
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
