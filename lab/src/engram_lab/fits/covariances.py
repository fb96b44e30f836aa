"""Fits what covariances of matches and of steps of odometry claim beyond their residuals.

    python -m engram_lab.fits.covariances            # towns that nothing is judged on
    python -m engram_lab.fits.covariances --towns 301 --every 4

Pairs of frames of different drives, up to 7 m apart, are matched near their true pose, and steps of
odometry measured. Of each weather the share of errors within the ellipsoids that should hold 50, 90
and 99 % is compared with these; the settings of `MatcherConfig` and `OdometryConfig` that come
closest are printed. What calibration leaves open does not show in rendered towns: those settings
are from real clips, and stay.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from scipy.stats import chi2

from engram.frontend.frame import Frame
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry.se3 import SE3
from engram.odometry.odometry import Odometry, OdometryConfig
from engram.robot.settings import Settings
from engram_lab.accuracy import LEVELS, squared
from engram_lab.misplaced import FALSE_M, FALSE_RAD
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.trial_towns import FITTED_TOWNS, drives_in, light_of, trial_town

# What a level that is missed by a point costs: the ends matter more than the middle.
COSTS = (0.3, 1.0, 2.0)
_FARTHEST_M, _LEAST_INLIERS, _FEWEST = 7.0, 20, 50
_NEAR = np.diag([0.3**2] * 3 + [0.02**2] * 3)
# Tried values of each setting.
MATCHER = {
    "few_inliers": (15.0, 20.0, 25.0, 30.0, 40.0),
    "displaced_m": (1.0, 1.5, 2.0, 3.0, 4.0),
    "offset_doubt": (0.0, 0.5, 1.0, 1.5),
}
ODOMETRY = {"few_inliers": (100.0, 200.0, 300.0, 400.0, 500.0)}

Chi2 = Mapping[str, Sequence[float]]
Config = TypeVar("Config", MatcherConfig, OdometryConfig)


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two frames, the weather of the later one, and the true pose between them."""

    weather: str
    reference: Frame
    live: Frame
    truth: SE3


@dataclass(frozen=True, slots=True, eq=False)
class Driven:
    """The frames of one drive, and where they were taken."""

    weather: str
    frames: list[Frame]
    world_from_frame: list[SE3]


def driven_in(town: int) -> list[Driven]:
    """The drives of a town."""
    found = []
    for drive, plan in zip(drives_in(town, Settings()), trial_town(town).sessions, strict=True):
        truth, frames = drive.truth(), [logged.frame for logged in drive.frames()]
        assert truth is not None
        poses = [truth.at(frame.stamp_ns) for frame in frames]
        found.append(Driven(light_of(plan), frames, [pose for pose in poses if pose is not None]))
    return found


def pairs_in(town: int, every: int) -> Iterator[Pair]:
    """Each so many frames of each drive, with a frame near it of each other drive."""
    rng = np.random.default_rng(town)
    for mapped, live in itertools.permutations(driven_in(town), 2):
        at_m = np.array([pose.translation for pose in mapped.world_from_frame])
        for number in range(0, len(live.frames), every):
            world_from_live = live.world_from_frame[number]
            far_m = np.linalg.norm(at_m - world_from_live.translation, axis=1)
            near = int(rng.choice(np.flatnonzero(far_m < far_m.min() + _FARTHEST_M)))
            truth = mapped.world_from_frame[near].inverse() @ world_from_live
            yield Pair(live.weather, mapped.frames[near], live.frames[number], truth)


def matched(pairs: Sequence[Pair], config: MatcherConfig) -> Chi2:
    """χ² of right matches by weather."""
    found = defaultdict(list)
    for seed, pair in enumerate(pairs):
        match = match_frames(pair.reference, pair.live, config, seed, pair.truth, _NEAR)
        pose, covariance = match.reference_from_live, match.covariance
        if pose is None or covariance is None or match.inliers < _LEAST_INLIERS:
            continue
        off = pair.truth.inverse() @ pose
        if off.distance_m <= FALSE_M and off.angle_rad <= FALSE_RAD:
            found[pair.weather].append(squared(pose, covariance, pair.truth))
    return found


def stepped(drives: Sequence[Driven], config: OdometryConfig) -> Chi2:
    """χ² of steps of odometry by weather."""
    found = defaultdict(list)
    for drive in drives:
        engine = Odometry(config)
        steps = [engine.step(frame) for frame in drive.frames]
        for step, (a, b) in zip(steps[1:], itertools.pairwise(drive.world_from_frame), strict=True):
            if step.prev_from_curr is not None and step.covariance is not None:
                chi = squared(step.prev_from_curr, step.covariance, a.inverse() @ b)
                found[drive.weather].append(chi)
    return found


def cost(found: Chi2) -> float:
    """How far coverage is off, over all kinds of weather."""
    total = 0.0
    for values in found.values():
        if len(values) >= _FEWEST:
            for level, each in zip(LEVELS, COSTS, strict=True):
                inside = float(np.mean(np.array(values) <= chi2.ppf(level, 6)))
                total += each * abs(100 * (inside - level)) ** 1.5
    return total


def _with(config: Config, name: str, value: float) -> Config:
    changed: dict[str, Any] = {name: value}
    return replace(config, **changed)


def fitted_matcher(pairs: Sequence[Pair], config: MatcherConfig) -> MatcherConfig:
    """The settings that cost least, one after another, twice over."""
    for name, values in 2 * list(MATCHER.items()):
        costs = {v: cost(matched(pairs, _with(config, name, v))) for v in values}
        config = _with(config, name, min(costs, key=lambda value: costs[value]))
        print(name, {value: round(each) for value, each in costs.items()}, flush=True)
    return config


def fitted_odometry(drives: Sequence[Driven], config: OdometryConfig) -> OdometryConfig:
    """The same of odometry."""
    for name, values in ODOMETRY.items():
        costs = {v: cost(stepped(drives, _with(config, name, v))) for v in values}
        config = _with(config, name, min(costs, key=lambda value: costs[value]))
        print(f"odometry: {name}", {value: round(each) for value, each in costs.items()})
    return config


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--towns", type=numbers, default=list(FITTED_TOWNS))
    parser.add_argument("--every", type=int, default=6, help="frames")
    asked = parser.parse_args()
    pairs = [pair for town in asked.towns for pair in pairs_in(town, asked.every)]
    matcher = fitted_matcher(pairs, Settings().localiser.matcher)
    drives = [drive for town in asked.towns for drive in driven_in(town)]
    odometry = fitted_odometry(drives, Settings().odometry)
    rows = [Figure(name, getattr(matcher, name)) for name in MATCHER]
    rows += [Figure(f"odometry: {name}", getattr(odometry, name)) for name in ODOMETRY]
    report(rows, asked.json, "settings that cost least")


if __name__ == "__main__":
    main()
