"""Fits the constants of Γ(recall) by replaying the sessions of a town, each left out in turn.

One map is built from all drives of the campaigns given; then each drive is localised again in that
map as if it had never been there: its nodes are no candidates, its path and attempts teach nothing.
Now and then every candidate is attempted, to see which would have matched. A logistic regression
gives the factors, a coarse search over what memories are long and whom to trust gives the rest.

Constants are fitted on towns that nothing is judged on:

    engram simulate village --seed 2
    python benchmarks/fit_recall.py village@2 --work fit --json fit/recall.json

Prints the constants as they stand in `engram.ranking.recall`, and how often two attempts would
have been enough, by sessions left out of the fit, beside other policies on the same frames.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from engram.cli.simulation import campaigns_folder
from engram.drive import OpenMap, Settings, open_map
from engram.evaluation.building import GENEROUS, build_map, true_nodes
from engram.evaluation.drives import EvaluatedDrive, campaign_logs, drives_of
from engram.evaluation.memo import MatchMemo
from engram.experience.neighbourhood import Neighbourhood
from engram.frontend.matching import matcher_hash
from engram.localiser import Budget, FrameMatcher
from engram.odometry import OdometryStatus, OdometryStep
from engram.ranking import POLICIES, RankingContext, RankingPolicy, policy_named
from engram.ranking.recall import RECALL, RecallConstants, RecallPolicy
from engram.simulation import campaign_named

FACTORS = ("bias", "offset", "company", "own", "node", "hour")
TERMS = ("bias", "distance", "company", "this run", "this node", "hour")
# Candidates so far away that hardly any matches say nothing about appearance.
LEAST_RATE = 0.02
RIDGE = 1.0
SEARCHED: dict[str, tuple[float, ...]] = {
    "own_m": (3.0, 5.0, 8.0, 12.0),
    "node_m": (2.0, 3.0, 6.0),
    "viewers_m": (8.0, 15.0, 30.0, 60.0),
    "trust": (0.1, 0.2, 0.35, 0.5, 0.8),
    "viewer_hour": (0.0, -0.1, -0.2, -0.4),
}
AS_SHIPPED = ("recall", "recall-no-clock", "bandit", "path", "distance", "time-of-day")
# Of equals the first is taken: where it does not matter, picks are diverse.
REGRETS = (1.0, 0.5, 0.25, 0.0)


@dataclass(frozen=True)
class Seen:
    """A frame's situation, and which candidates would have matched."""

    session: int
    context: RankingContext
    accepted: NDArray[np.bool_]


@dataclass
class Recording:
    """Ranks as another policy does, and looks at what would have matched every few frames."""

    policy: RankingPolicy
    session: int
    every: int
    name: str = "recording"
    frames: int = 0
    seen: list[Seen] = field(default_factory=list)

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        if self.frames % self.every == 0 and context.foresee is not None:
            foreseen = context.foresee()
            kept = dataclasses.replace(context, foresee=None, live_words=None)
            self.seen.append(Seen(self.session, kept, foreseen.accepted))
        self.frames += 1
        return self.policy.rank(context)


def replay(
    opened: OpenMap,
    drives: Sequence[EvaluatedDrive],
    left_out: int,
    policy: RankingPolicy,
    work: Path,
    every: int,
) -> list[Seen]:
    """Localises one drive in the map without what it left there itself; Np = 2, Nr = 1."""
    drive, settings = drives[left_out], Settings()
    settings = dataclasses.replace(
        settings, localiser=dataclasses.replace(settings.localiser, guide_below_m=0.0)
    )
    matcher = settings.localiser.matcher
    memo = MatchMemo(
        FrameMatcher(opened.store.frames, matcher),
        work / f"memo-{drive.name}.npz",
        matcher_hash(matcher),
    )
    own = opened.graph.session_number(drive.session.id)

    def search(*args: object, **options: object) -> Neighbourhood:
        found = opened.graph.neighbourhood(*args, **options)
        return found.rows(np.flatnonzero(opened.graph.sessions[found.nodes] != own))

    others = [one for number, one in enumerate(drives) if number != left_out]
    recording = Recording(policy, left_out, every)
    truth, frames = drive.truth(), drive.frames()
    start = None if truth is None else truth.at(frames[0].frame.stamp_ns)
    begin = None if start is None else true_nodes(opened, others).start(start)
    if begin is None:
        return []
    POLICIES[recording.name] = lambda: recording
    with opened.localiser(
        drive.camera,
        settings,
        policy=recording.name,
        budget=Budget(2, 1),
        relocaliser=None,
        live=drive.session.id,
        matcher=memo,
        search=search,
        clock=drive.session,
    ) as localiser:
        localiser.start_at(begin)
        for number, logged in enumerate(frames):
            first = OdometryStep(OdometryStatus.FIRST)
            localiser.localise(logged.frame, logged.odometry if number else first)
    memo.save()
    return recording.seen


def features(
    seen: Sequence[Seen], structure: RecallConstants, *, clock: bool
) -> NDArray[np.float64]:
    """(C, F) what the factors multiply, of all candidates that `worth` keeps."""
    plain = dataclasses.replace(structure, **dict.fromkeys(FACTORS, 1.0))
    policy = RecallPolicy(clock=clock, constants=plain)
    rows = []
    for one in seen:
        terms = policy.judge(one.context).terms
        nothing = np.zeros(len(one.accepted))
        columns = [terms.get(name, nothing) for name in TERMS]
        rows.append(np.stack(columns, axis=1)[worth(one)])
    return np.concatenate(rows)


def worth(seen: Seen) -> NDArray[np.bool_]:
    """Candidates near enough to learn from."""
    return seen.context.success_rates() >= LEAST_RATE


def fit(x: NDArray[np.float64], y: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Logistic regression with a small ridge on all factors but the bias."""
    ridge = np.array([0.0] + [RIDGE] * (x.shape[1] - 1))

    def loss(b: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        z = x @ b
        value = np.logaddexp(0, z).sum() - z[y].sum() + (ridge * b**2).sum()
        return float(value), x.T @ (1 / (1 + np.exp(-z)) - y) + 2 * ridge * b

    return np.asarray(minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B").x)


def log_loss(x: NDArray[np.float64], y: NDArray[np.bool_], b: NDArray[np.float64]) -> float:
    """Mean negative log likelihood, nats."""
    z = x @ b
    return float((np.logaddexp(0, z).sum() - z[y].sum()) / len(y))


def search_structure(seen: Sequence[Seen], *, clock: bool) -> RecallConstants:
    """One setting after another, twice round, by log loss; then how much a pick regrets."""
    best = RECALL
    y = np.concatenate([one.accepted[worth(one)] for one in seen])

    def loss(structure: RecallConstants) -> float:
        x = features(seen, structure, clock=clock)
        return log_loss(x, y, fit(x, y))

    known: dict[RecallConstants, float] = {}
    for _ in range(2):
        for name, values in SEARCHED.items():
            if name == "viewer_hour" and not clock:
                continue
            tried = [dataclasses.replace(best, **{name: value}) for value in values]
            for one in tried:
                if one not in known:
                    known[one] = loss(one)
            best = min(tried, key=lambda one: known[one])
    return with_factors(seen, best, clock=clock)


def with_factors(
    seen: Sequence[Seen], structure: RecallConstants, *, clock: bool
) -> RecallConstants:
    """The structure with factors by regression and the regret that leaves fewest frames lost."""
    y = np.concatenate([one.accepted[worth(one)] for one in seen])
    b = fit(features(seen, structure, clock=clock), y)
    factors = dict(zip(FACTORS, (round(float(value), 3) for value in b), strict=True))
    fitted = dataclasses.replace(structure, **factors)
    tried = [dataclasses.replace(fitted, regret=regret) for regret in REGRETS]
    return min(tried, key=lambda one: missed(seen, RecallPolicy(clock=clock, constants=one)).mean())


def missed(seen: Sequence[Seen], policy: RankingPolicy, lanes: int = 2) -> NDArray[np.bool_]:
    """For each frame where something would have matched, whether all of the first picks fail."""
    return np.array(
        [
            not one.accepted[policy.rank(one.context)[:lanes]].any()
            for one in seen
            if one.accepted.any()
        ]
    )


def left_out_misses(seen: Sequence[Seen], structure: RecallConstants, *, clock: bool) -> float:
    """Share of frames missed by constants whose factors were fitted on the other sessions."""
    parts = []
    for session in sorted({one.session for one in seen}):
        others = [one for one in seen if one.session != session]
        fitted = with_factors(others, structure, clock=clock)
        own = [one for one in seen if one.session == session]
        parts.append(missed(own, RecallPolicy(clock=clock, constants=fitted)))
    return float(np.concatenate(parts).mean())


def rendered(name: str, campaigns: Path) -> tuple[EvaluatedDrive, ...]:
    """The drives of NAME@SEED that are rendered."""
    campaign, _, seed = name.partition("@")
    logs = campaign_logs(campaign_named(campaign, int(seed)), campaigns)
    # A log beside which the truth is missing is still being written.
    return drives_of([log for log in logs if log.with_suffix(".truth.txt").exists()])


def recorded(
    names: Sequence[str], campaigns: Path, work: Path, every: int, policy: RankingPolicy
) -> Iterator[Seen]:
    """All campaigns' drives, each left out in turn."""
    for name in names:
        drives = rendered(name, campaigns)
        folder = work / name.replace("@", "-seed")
        folder.mkdir(parents=True, exist_ok=True)
        built = build_map(folder / "all.engram", drives, Settings(), GENEROUS)
        with open_map(built.path) as opened:
            for left_out, drive in enumerate(drives):
                found = replay(opened, drives, left_out, policy, folder, every)
                print(f"{name} {drive.name}: {len(found)} frames", flush=True)
                yield from found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("towns", nargs="+", help="rendered campaigns, NAME@SEED")
    parser.add_argument("--campaigns", type=Path, default=campaigns_folder())
    parser.add_argument("--work", type=Path, required=True, help="for the map and the matches")
    parser.add_argument(
        "--every", type=int, default=3, help="frames from one looked at to the next"
    )
    parser.add_argument("--rounds", type=int, default=2, help="of recording and fitting")
    parser.add_argument("--json", type=Path, help="write the constants")
    options = parser.parse_args()
    policy: RankingPolicy = policy_named("recall")
    found: dict[str, RecallConstants] = {}
    for number in range(options.rounds):
        seen = list(recorded(options.towns, options.campaigns, options.work, options.every, policy))
        for name, clock in (("recall", True), ("recall-no-clock", False)):
            found[name] = search_structure(seen, clock=clock)
            share = left_out_misses(seen, found[name], clock=clock)
            print(f"round {number}: {name} misses {share:.2%}, sessions left out\n  {found[name]}")
        for name in AS_SHIPPED:
            share = float(missed(seen, policy_named(name)).mean())
            print(f"round {number}: {name} as it ships misses {share:.2%}")
        policy = RecallPolicy(constants=found["recall"])
    if options.json:
        plain = {name: dataclasses.asdict(one) for name, one in found.items()}
        options.json.write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
