"""Fits the constants of Γ(recall) on towns that nothing is judged on.

    engram lab simulate village --seed 2
    python -m engram_lab.fits.recall village@2 --work fit --json fit/recall.json

A map is built from the drives of each campaign given, one after another; each drive is localised
in the map of all before it, attempting every candidate of every frame, to see which would match.
Then any policy can be replayed in seconds: it sees the outcomes of its own picks alone. Constants
are searched, one after another, for the least share of the route on which something would have
matched and the first picks do not; the two that give chances come from a logistic regression.

Prints that share for the constants as they ship, for those found, with each drive left out of the
search that it is judged by, and for other policies; and what each value of each constant costs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from engram.localiser.localisation import Budget
from engram.maps.map import Map, open_map
from engram.odometry.motion import GapFiller
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.ranking.context import Foreseen, RankingContext, RankingPolicy
from engram.ranking.policies import policy_named
from engram.ranking.recall import RECALL, RecallConstants, RecallPolicy
from engram.ranking.recent import AttemptHistory
from engram.robot.localisers import localiser_in
from engram.robot.settings import Settings
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.building import GENEROUS, build_map, true_nodes
from engram_lab.studies.drives import EvaluatedDrive, campaign_logs, drives_of
from engram_lab.studies.lockstep import MatchMemo
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.simulating import campaigns_folder

SEARCHED: dict[str, tuple[Any, ...]] = {
    "distance": (0.4, 0.7, 1.1, 1.5, 2.2),
    "lessons": (0.0, 0.15, 0.3, 0.6),
    "level": (-0.5, 0.0, 0.5, 1.0),
    "prior_weight": (0.25, 0.5, 1.0, 2.0),
    "memory_m": (2.0, 4.0, 8.0, 16.0),
    "regret": (0.0, 1.0, 2.0, 4.0),
    "tally": (0.0, 0.25, 0.5, 1.0),
    "tally_memory_m": (4.0, 8.0, 16.0),
}
CHANCES = ("bias", "steepness")
# Replays start from where the robot truly was: these say nothing there.
WHEN_LOST = ("likeness", "vague_m")
# What a node that nobody tried is believed to do, and how much is looked at: not searched.
COUNTED = ("untried_rate", "untried_attempts", "needed", "attempts", "picks", "shortlist")
OTHERS = ("bandit", "path-near", "distance", "time-of-day")
# A robot that has so many candidates does not know where it is; to match all takes long.
MOST_CANDIDATES = 200


@dataclass(frozen=True)
class Seen:
    """A frame's situation but for the policy's own attempts, and which candidates would match."""

    context: RankingContext
    foreseen: Foreseen
    driven_m: float
    step_m: float


@dataclass(frozen=True)
class Recorded:
    """One drive, every frame of it."""

    name: str
    frames: tuple[Seen, ...]
    length_m: float


@dataclass
class Recording:
    """Ranks as the oracle does and keeps what it sees."""

    name: str = "recording"
    oracle: RankingPolicy = field(default_factory=lambda: policy_named("oracle"))
    seen: list[tuple[RankingContext, Foreseen]] = field(default_factory=list)

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        if len(context.neighbourhood) > MOST_CANDIDATES or context.foresee is None:
            return policy_named("distance").rank(context)
        foreseen = context.foresee()
        kept = dataclasses.replace(context, foresee=None, live_words=None)
        self.seen.append((kept, foreseen))
        return self.oracle.rank(dataclasses.replace(context, foresee=lambda: foreseen))


def record(
    opened: Map, drive: EvaluatedDrive, known: Sequence[EvaluatedDrive], work: Path
) -> Recorded:
    """Localises a drive that the map does not hold, attempting everything."""
    settings = Settings()
    settings = dataclasses.replace(
        settings, localiser=dataclasses.replace(settings.localiser, guide_below_m=0.0)
    )
    memo = MatchMemo.of(opened, drive, settings, work)
    recording, truth, logged = Recording(), drive.truth(), drive.frames()
    first = None if truth is None else truth.at(logged[0].frame.stamp_ns)
    start = None if first is None else true_nodes(opened, known).start(first)
    frames, length_m = [], 0.0
    if start is None:
        return Recorded(drive.name, (), 0.0)
    with localiser_in(
        opened,
        drive.camera,
        settings,
        policy=recording,
        budget=Budget(2, 1),
        relocaliser=None,
        live=drive.session.id,
        matcher=memo,
        clock=drive.session,
    ) as localiser:
        localiser.place_at(start)
        gaps = GapFiller()
        for number, one in enumerate(logged):
            odometry = one.odometry if number else OdometryStep(OdometryStatus.FIRST)
            motion = odometry.prev_from_curr
            step_m = 0.0 if motion is None else motion.distance_m
            localiser.move(
                gaps.motion(odometry, one.frame.stamp_ns, landmarks=len(one.frame.landmarks))
            )
            length_m += step_m
            before = len(recording.seen)
            localiser.localise(one.frame)
            frames += [Seen(*seen, localiser.driven_m, step_m) for seen in recording.seen[before:]]
    memo.save()
    return Recorded(drive.name, tuple(frames), length_m)


def replay(
    drive: Recorded, policy: RankingPolicy, lanes: int = 2
) -> Iterator[tuple[Seen, RankingContext, NDArray[np.int64]]]:
    """Each frame with what the policy got to see and what it picked, as if it had driven."""
    history = AttemptHistory()
    reference = drive.frames[0].context.reference if drive.frames else None
    for seen in drive.frames:
        history.begin_frame(seen.driven_m)
        context = dataclasses.replace(
            seen.context,
            observations=history.observations,
            run=history.run(),
            reference=reference,
        )
        picks = policy.rank(context)[:lanes]
        near, accepted = context.neighbourhood, seen.foreseen.accepted[picks]
        nodes, inliers = near.nodes[picks].tolist(), seen.foreseen.inliers[picks]
        rates = context.success_rates()[picks]
        away_m = np.where(accepted, near.distance_m[picks], near.rms_distance_m[picks])
        history.add(nodes, (away_m, rates), accepted.tolist(), list(inliers), 0)
        if accepted.any():
            reference = nodes[int(np.argmax(np.where(accepted, inliers, -1)))]
        yield seen, context, picks


def missed(drive: Recorded, policy: RankingPolicy, lanes: int = 2) -> float:
    """Share of the route on which something would match and none of the first picks does."""
    lost_m = sum(
        seen.step_m
        for seen, _, picks in replay(drive, policy, lanes)
        if seen.foreseen.accepted.any() and not seen.foreseen.accepted[picks].any()
    )
    return lost_m / max(drive.length_m, 1e-9)


class Costs:
    """What constants cost on each drive; worked out once."""

    def __init__(self, drives: Sequence[Recorded]) -> None:
        self._drives = drives
        self._known: dict[RecallConstants, NDArray[np.float64]] = {}

    def __call__(self, constants: RecallConstants) -> NDArray[np.float64]:
        """(D,) share missed of each drive."""
        if constants not in self._known:
            policy = RecallPolicy(constants)
            self._known[constants] = np.array([missed(one, policy) for one in self._drives])
        return self._known[constants]


def search(
    cost: Callable[[RecallConstants], float], start: RecallConstants = RECALL
) -> RecallConstants:
    """One constant after another, until none gets better; of equals the first is taken."""
    best, before = start, None
    while best != before:
        before = best
        for name, values in SEARCHED.items():
            tried = [best, *(dataclasses.replace(best, **{name: value}) for value in values)]
            best = min(tried, key=cost)
    return best


def with_chances(drives: Sequence[Recorded], constants: RecallConstants) -> RecallConstants:
    """The constants with bias and steepness by logistic regression on all candidates."""
    policy = RecallPolicy(constants)
    margins, outcomes = [], []
    for drive in drives:
        for number, (seen, context, _) in enumerate(replay(drive, policy)):
            if number % 5 == 0:
                margins.append(sum(policy.judge(context).terms.values()))
                outcomes.append(seen.foreseen.accepted)
    bias, steepness = logistic(np.concatenate(margins), np.concatenate(outcomes))
    return dataclasses.replace(constants, bias=round(bias, 1), steepness=round(steepness, 1))


def logistic(x: NDArray[np.float64], y: NDArray[np.bool_]) -> tuple[float, float]:
    """Log odds of y at x = 0, and per x."""

    def loss(b: NDArray[np.float64]) -> float:
        z = b[0] + b[1] * x
        return float(np.logaddexp(0, z).sum() - z[y].sum())

    bias, slope = minimize(loss, np.array([0.0, 1.0])).x
    return float(bias), float(slope)


def rendered(name: str, campaigns: Path) -> tuple[EvaluatedDrive, ...]:
    """The drives of NAME@SEED that are rendered."""
    campaign, _, seed = name.partition("@")
    logs = campaign_logs(campaign_named(campaign, int(seed)), campaigns)
    # A log beside which the truth is missing is still being written.
    return drives_of([log for log in logs if log.with_suffix(".truth.txt").exists()])


def recorded(names: Sequence[str], campaigns: Path, work: Path) -> Iterator[Recorded]:
    """All campaigns' drives but the first, each in the map of those before it."""
    for name in names:
        drives = rendered(name, campaigns)
        folder = work / name.replace("@", "-seed")
        folder.mkdir(parents=True, exist_ok=True)
        built = build_map(folder / "all.engram", drives, Settings(), GENEROUS)
        for number, drive in enumerate(drives[1:], start=1):
            with open_map(built.path, at=built.revision_after(number)) as opened:
                one = record(opened, drive, drives, folder)
            print(f"{name} {drive.name}: {len(one.frames)} frames", flush=True)
            if one.frames:
                yield one


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("towns", nargs="+", help="rendered campaigns, NAME@SEED")
    parser.add_argument("--campaigns", type=Path, default=campaigns_folder())
    parser.add_argument("--work", type=Path, required=True, help="for the map and the matches")
    parser.add_argument("--only-compare", action="store_true", help="search nothing")
    options = parser.parse_args()
    drives = list(recorded(options.towns, options.campaigns, options.work))
    costs = Costs(drives)
    print(f"recall as it ships misses {costs(RECALL).mean():.2%} of the route")
    for name in OTHERS:
        policy = policy_named(name)
        print(f"{name} misses {np.mean([missed(one, policy) for one in drives]):.2%}", flush=True)
    if options.only_compare:
        return
    for name, values in SEARCHED.items():
        around = [costs(dataclasses.replace(RECALL, **{name: value})).mean() for value in values]
        told = (f"{value:g}: {cost:.2%}" for value, cost in zip(values, around, strict=True))
        print(f"  {name} = {', '.join(told)}", flush=True)
    found = with_chances(drives, search(lambda one: float(costs(one).mean())))

    def without(k: int) -> Callable[[RecallConstants], float]:
        return lambda one: float(np.delete(costs(one), k).mean())

    left_out = [costs(search(without(k)))[k] for k in range(len(drives))]
    print(f"found {found}\n  misses {costs(found).mean():.2%}, left out {np.mean(left_out):.2%}")
    constants = dataclasses.asdict(found)
    report((Figure(name, value) for name, value in constants.items()), options.json, "constants")


if __name__ == "__main__":
    main()
