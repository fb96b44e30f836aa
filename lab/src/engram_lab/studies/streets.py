"""Streets: a map and a drive in the same small town, with truth; robots that drive there.

What happens to a robot is a `Try`: it is undisturbed, starts lost, is given a wrong position, is
carried elsewhere, or loses its odometry. `WrongPlaces` searches look-alikes: each frame of a drive
is matched with each node at least `OFF_M` from it, as by a lost robot. Few robots that are
misplaced by chance meet one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.config import config_hash
from engram.frontend.frame import BRIEF
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId, node_id
from engram.localiser.acceptance import Prediction
from engram.localiser.attempts import Attempter, Candidate, Outcome
from engram.localiser.confidence import UNKNOWN, Standing
from engram.localiser.localisation import Budget, Localisation, Position
from engram.localiser.settings import METHOD_VERSION
from engram.maps.map import Map, open_map
from engram.monitor import QUIET, Monitor
from engram.odometry.outside import OutsideMotion
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.front import Front
from engram.robot.localisers import localiser_in
from engram.robot.robot import Robot
from engram.robot.settings import Settings
from engram.sequences.sequence import LoggedFrame
from engram_lab.accuracy import Count, Fix, is_false
from engram_lab.studies.building import GENEROUS, build_map, true_nodes
from engram_lab.studies.drives import EvaluatedDrive, campaign_logs, drives_of
from engram_lab.town.campaigns import Campaign, SessionPlan, campaign_named
from engram_lab.town.simulating import campaign_folder, campaigns_folder, simulate

# A robot is misplaced by at least this much, given so with these standard deviations.
OFF_M = 15.0
SIGMAS_M = (0.1, 1.0, 3.0)
SIGMA_RAD = float(np.deg2rad(2.0))
# Frames that a robot drives before it is carried elsewhere, and after.
_BEFORE, FRAMES = 15, 40


class Kind(StrEnum):
    """What happens to a robot."""

    UNDISTURBED = "undisturbed"
    COLD = "cold start"
    MISPLACED = "given a wrong place"
    CARRIED = "carried elsewhere"
    GAP = "past a gap"
    LOST = "lost"


# Such robots drive to the end.
_TO_THE_END = frozenset({Kind.UNDISTURBED, Kind.COLD})


@dataclass(frozen=True, slots=True)
class Try:
    """One robot.

    Attributes:
        first: its first frame, or that after a gap or where it was carried to; undisturbed robots
            and those that start lost drive to the end of the drive.
        sigma_m: of a wrong place that it is given; 0 else.
    """

    kind: Kind
    first: int = 0
    sigma_m: float = 0.0
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """One frame of such a robot: result, attempts, and the frame's number in the drive.

    `counts`: whether it is one of the `FRAMES` after what happened.
    """

    found: Localisation
    outcomes: list[Outcome]
    frame: int
    counts: bool = True


class Street:
    """A map and a drive in the same town, with truth.

    Args:
        settings: of robots; maps are built with the default `localiser` and `gaps`.
    """

    def __init__(
        self,
        path: Path,
        mapped: Sequence[EvaluatedDrive],
        live: EvaluatedDrive,
        settings: Settings,
        lost_rounds: int = Budget().lost_rounds,
        *,
        same_town: bool = True,
    ) -> None:
        mapping = mapping_settings(settings)
        self.opened: Map = open_map(build_map(path, mapped, mapping, GENEROUS).path)
        self.live, self.settings = live, settings
        self._budget = Budget(lost_rounds=lost_rounds)
        self.nodes = true_nodes(self.opened, mapped)
        self.frames = live.frames()
        self.same_town = same_town

    def close(self) -> None:
        """Closes the map."""
        self.opened.close()

    @cached_property
    def truth(self) -> list[SE3]:
        """world_from_live of each frame."""
        truth = self.live.truth()
        assert truth is not None
        poses = [truth.at(one.frame.stamp_ns) for one in self.frames]
        return [pose for pose in poses if pose is not None]

    @cached_property
    def _at_m(self) -> NDArray[np.float64]:
        return np.array([pose.translation for pose in self.truth])

    def error(self, frame: int, node: NodeId, node_from_live: SE3) -> tuple[float, float] | None:
        """Error of a pose, metres and rad; None if the node's truth is unknown."""
        if not self.same_town:
            return np.inf, np.pi
        world_from_node = self.nodes.pose(node)
        if world_from_node is None:
            return None
        wrong = self.truth[frame].inverse() @ world_from_node @ node_from_live
        return wrong.distance_m, wrong.angle_rad

    def is_false(self, frame: int, node: NodeId, node_from_live: SE3) -> bool | None:
        """Whether a pose is more than 1 m or 5° off; None if that is not known."""
        error = self.error(frame, node, node_from_live)
        return None if error is None else is_false(*error)

    def fix(self, at: int, frame: int, found: Localisation) -> Fix | None:
        """The fix of a frame; None without one, or if its truth is unknown."""
        if found.node is None or found.node_from_live is None:
            return None
        error = self.error(frame, found.node, found.node_from_live)
        return None if error is None else Fix(at, error[0], is_false(*error), found.confidence)

    def count(self, one: Try, *, outside: Sequence[OutsideMotion | None] | None = None) -> Count:
        """What a robot makes of the frames that count."""
        looked = [each for each in self.run(one, outside=outside) if each.counts]
        return self.counted([(each.frame, each.found) for each in looked])

    def counted(self, found: Sequence[tuple[int, Localisation]], after: int = 0) -> Count:
        """What a robot made of frames, by their numbers; `after`: see `Count.of`."""
        fixes = [self.fix(at, frame, one) for at, (frame, one) in enumerate(found)]
        poses = [self.truth[frame] for frame, _ in found]
        return Count.of([one for one in fixes if one is not None], poses, after)

    def robot(
        self,
        *,
        relocalises: bool = True,
        camera: StereoCamera | None = None,
        front: Front | None = None,
    ) -> Robot:
        """A robot that localises the drive; camera and front are the drive's unless given."""
        localiser = localiser_in(
            self.opened,
            camera or self.live.camera,
            self.settings,
            budget=self._budget,
            relocaliser="fabmap" if relocalises else None,
            live=self.live.session.id,
            threads=1,
        )
        return Robot(front or Front(self.settings), localiser)

    def run(
        self,
        one: Try,
        *,
        relocalises: bool = True,
        outside: Sequence[OutsideMotion | None] | None = None,
    ) -> Iterator[Looked]:
        """Drives the robot, frame by frame.

        Args:
            outside: what its wheels and gyroscope measure before each frame of the drive, of a
                robot that is shown all frames; None without them.
        """
        with self.robot(relocalises=relocalises) as robot:
            shown = self._shown(one)
            start = self._start(one, shown[0])
            if start is not None:
                robot.place_at(start)
            for number, frame in enumerate(shown):
                motion = None if outside is None else outside[frame]
                found = robot.step(self._logged(one, shown, number), motion=motion)
                counts = one.kind in _TO_THE_END or number >= len(shown) - FRAMES
                yield Looked(found, robot.outcomes, frame, counts)

    def tries(self, kind: Kind, count: int, seed: int) -> list[Try]:
        """So many robots, evenly along the drive; undisturbed ones from its first frame."""
        if kind is Kind.UNDISTURBED:
            return [Try(kind, 0, 0.0, seed + k) for k in range(count)]
        last = len(self.frames) - FRAMES
        firsts = np.linspace(_BEFORE + 30, last, count).astype(int)
        sigmas = [SIGMAS_M[k % 3] if kind is Kind.MISPLACED else 0.0 for k in range(count)]
        return [
            Try(kind, int(first), sigma, seed + k)
            for k, (first, sigma) in enumerate(zip(firsts, sigmas, strict=True))
        ]

    def _shown(self, one: Try) -> list[int]:
        """Numbers of the frames that the robot is shown."""
        after = range(one.first, one.first + FRAMES)
        if one.kind in _TO_THE_END:
            return list(range(one.first, len(self.frames)))
        if one.kind is Kind.CARRIED:
            elsewhere = self._elsewhere(one)
            first = max(elsewhere - _BEFORE, 0)
            return [*range(first, first + _BEFORE), *after]
        if one.kind is Kind.GAP:
            gap = int(np.random.default_rng([one.seed, 7]).integers(5, 30))
            last = max(one.first - gap, 1)
            return [*range(max(last - _BEFORE, 0), last), *after]
        return list(after)

    def _start(self, one: Try, first: int) -> Position | None:
        if one.kind in {Kind.LOST, Kind.COLD}:
            return None
        if one.kind is not Kind.MISPLACED:
            return self.nodes.start(self.truth[first])
        start = self.nodes.start(self.truth[self._elsewhere(one)])
        spread = np.diag([one.sigma_m**2] * 3 + [SIGMA_RAD**2] * 3)
        return None if start is None else replace(start, covariance=spread)

    def _elsewhere(self, one: Try) -> int:
        """A frame at least `OFF_M` from the first, seen in the same direction or not."""
        apart_m = np.linalg.norm(self._at_m - self._at_m[one.first], axis=1)
        rng = np.random.default_rng([one.seed, one.first])
        return int(rng.choice(np.flatnonzero(apart_m >= OFF_M)))

    def _logged(self, one: Try, shown: Sequence[int], number: int) -> LoggedFrame:
        """A frame as the robot meets it.

        Past a gap odometry fails. That of a carried robot reports its usual motion, and its clock
        keeps running: stamps before are moved to where it was carried to.
        """
        frame = shown[number]
        logged, carried = self.frames[frame], one.kind is Kind.CARRIED
        if number == 0:
            logged = replace(logged, odometry=OdometryStep(OdometryStatus.FIRST))
        elif frame != shown[number - 1] + 1 and not carried:
            logged = replace(logged, odometry=OdometryStep(OdometryStatus.NO_CONSENSUS))
        if not carried or number >= _BEFORE:
            return logged
        stamps = [self.frames[k].frame.stamp_ns for k in (one.first - 1, shown[_BEFORE - 1])]
        stamp_ns = logged.frame.stamp_ns + stamps[0] - stamps[1]
        return replace(logged, frame=replace(logged.frame, stamp_ns=stamp_ns))


# Matches of fewer inliers can be no fix by any rule.
LEAST_INLIERS = 12
# Fixes that should have come since the robot is misplaced, at most; until it doubts by itself. And
# fixes of one that was carried before.
_MOST_MISSED = 3.0
_CONFIRMED = 20


class WrongPlaces:
    """All attempts of a drive at the nodes of a map that are elsewhere."""

    def __init__(self, street: Street, every: int = 1) -> None:
        self._street, self._every = street, every
        opened, config = street.opened, street.settings.localiser
        self._config = config
        self._attempter = Attempter(opened.frames, config)
        self._nodes = opened.graph.nodes
        self.attempts = 0

    def lost(self) -> Iterator[tuple[int, Outcome]]:
        """As by a lost robot, without a prediction: live frame and attempt of false poses.

        Attempts of fewer than `LEAST_INLIERS` are left out.
        """
        for frame in range(0, len(self._street.frames), self._every):
            for index in self._elsewhere(frame):
                self.attempts += 1
                outcome = self._attempt(frame, index, None, UNKNOWN)
                if self._is_wrong(frame, outcome):
                    yield frame, outcome

    def expected(self, frame: int, there: Outcome, usual_inliers: float = 0.0) -> Iterator[Outcome]:
        """As by robots whose position is where such a match is, with each deviation.

        Args:
            usual_inliers: of the fixes of a robot that was carried; 0 for one that was placed.
        """
        pose, index = there.match.reference_from_live, there.candidate.index
        assert pose is not None
        rng = np.random.default_rng([frame, index])
        for sigma_m in SIGMAS_M:
            off = np.concatenate([rng.normal(0.0, sigma_m, 3), rng.normal(0.0, SIGMA_RAD, 3)])
            prediction = Prediction(pose @ SE3.exp(off), sigma_m, SIGMA_RAD)
            missed = float(rng.uniform(0.0, _MOST_MISSED))
            standing = Standing(missed=missed)
            if usual_inliers:
                tracked = float(self._tracked[frame])
                standing = Standing(_CONFIRMED, missed, usual_inliers, tracked)
            self.attempts += 1
            outcome = self._attempt(frame, index, prediction, standing)
            if self._is_wrong(frame, outcome):
                yield outcome

    @cached_property
    def _tracked(self) -> NDArray[np.float64]:
        """Share of the usual landmarks that odometry tracks to each frame; see `Standing`."""
        counts = np.array([one.odometry.inliers for one in self._street.frames], np.float64)
        known = counts > 0
        usual = float(np.median(counts[known])) if known.any() else 1.0
        return np.where(known, np.minimum(counts / usual, 1.0), 1.0)

    def _attempt(
        self, frame: int, index: int, prediction: Prediction | None, standing: Standing
    ) -> Outcome:
        live = self._street.frames[frame].frame
        guided = (
            prediction is not None
            and prediction.sigma_m < self._config.guide_below_m
            and prediction.sigma_yaw_rad < self._config.guide_below_rad
        )
        candidate = Candidate(
            index, self._nodes[index].id, prediction, guided, None, standing.agreed == 0, standing
        )
        seen = node_id(self._street.live.session.id, live.stamp_ns)
        return self._attempter.attempt(live, seen, 0, candidate)

    def _is_wrong(self, frame: int, outcome: Outcome) -> bool:
        """Whether enough landmarks agree on a pose, and it is false."""
        match = outcome.match
        if match.reference_from_live is None or match.inliers < LEAST_INLIERS:
            return False
        return bool(self._street.is_false(frame, outcome.candidate.node, match.reference_from_live))

    def _elsewhere(self, frame: int) -> NDArray[np.int64]:
        """Nodes by index whose truth is known and far from the frame's."""
        if not self._street.same_town:
            return np.arange(len(self._nodes))
        apart_m = np.linalg.norm(self._at_m - self._street.truth[frame].translation, axis=1)
        return np.flatnonzero(apart_m >= OFF_M)

    @cached_property
    def _at_m(self) -> NDArray[np.float64]:
        poses = [self._street.nodes.pose(node.id) for node in self._nodes]
        return np.array([np.full(3, np.nan) if p is None else p.translation for p in poses])


# Small towns that nothing else is judged on: `confidence` is fitted on some, tried on others.
FITTED_TOWNS = (301, 302)
HELD_OUT_TOWNS = (403, 404)
LOOP_M = 200.0
_NIGHT_FROM_H = 21
_FIRST_DAY = datetime(2025, 7, 14, tzinfo=UTC)
# Day, hour (UTC), weather and robot of each drive; two at night, one of them in rain.
_DRIVES = (
    (0, 8.5, "clear", "wildcat"), (0, 17.0, "clear", "courier"), (1, 11.0, "overcast", "wildcat"),
    (1, 22.5, "fair", "wildcat"), (2, 10.0, "showers", "courier"), (2, 23.0, "rain", "wildcat"),
)  # fmt: skip

# Later drives of such a town: six more in the usual direction, then three against it.
_LATER = (
    (3, 9.5, "fair", "wildcat", False), (3, 14.0, "overcast", "wildcat", False),
    (4, 16.0, "broken", "wildcat", False), (5, 11.0, "showers", "wildcat", False),
    (6, 12.0, "clear", "courier", False), (6, 22.0, "fair", "wildcat", False),
    (7, 9.0, "clear", "wildcat", True), (8, 10.0, "overcast", "wildcat", True),
    (8, 16.5, "fair", "wildcat", True),
)  # fmt: skip

# Each map is built from some drives, and localises another.
STREETS = (((0, 3), 1), ((2,), 0), ((2,), 4), ((1,), 2))
# The same at night, in maps of the day, and in rain at night.
AT_NIGHT = (((2,), 3), ((1,), 3), ((0, 3), 5))
_MAPPED = tuple(dict.fromkeys(mapped for mapped, _ in STREETS))


def trial_town(seed: int) -> Campaign:
    """Six drives around one loop, in all kinds of light, by two kinds of robots."""
    hamlet = campaign_named("hamlet", seed)
    sessions = tuple(
        replace(
            plan, start=_FIRST_DAY + timedelta(days=day, hours=hour), weather=weather, robot=robot
        )
        for plan, (day, hour, weather, robot) in zip(hamlet.sessions, _DRIVES, strict=True)
    )
    return replace(hamlet, name="trial", home="trial", length_m=LOOP_M, sessions=sessions)


def longer_trial_town(seed: int) -> Campaign:
    """The same town with nine more drives, the last three of them in the opposite direction."""
    town = trial_town(seed)
    first = town.sessions[0]
    later = tuple(
        SessionPlan(number, _FIRST_DAY + timedelta(days=day, hours=hour), weather, robot, reverse,
                    first.seed + 7919 * number)
        for number, (day, hour, weather, robot, reverse) in enumerate(_LATER, len(town.sessions))
    )  # fmt: skip
    return replace(town, sessions=(*town.sessions, *later))


def campaign_of(name: str) -> Campaign:
    """A campaign by NAME or NAME@SEED; a number alone is the longer trial town of that seed."""
    if name.isdecimal():
        return longer_trial_town(int(name))
    campaign, _, seed = name.partition("@")
    return campaign_named(campaign, int(seed or 1))


def light_of(plan: SessionPlan) -> str:
    """Weather of a drive, and whether it is by day."""
    return f"{plan.weather}, {'night' if plan.start.hour >= _NIGHT_FROM_H else 'day'}"


def mapping_settings(settings: Settings) -> Settings:
    """Those that maps are built with, for robots with some settings."""
    usual = Settings().for_descriptor(settings.frontend.descriptor)
    return replace(settings, localiser=usual.localiser, gaps=usual.gaps)


def towns_folder(settings: Settings) -> Path:
    """Where the towns stand as seen with a kind of features."""
    kind = settings.frontend.descriptor
    return campaigns_folder() if kind == BRIEF else campaigns_folder() / kind


def drives_in(
    campaign: Campaign,
    settings: Settings,
    sessions: Sequence[int] | None = None,
    monitor: Monitor = QUIET,
) -> dict[int, EvaluatedDrive]:
    """Drives of a campaign by number, all or some; renders what is not there yet."""
    folder = towns_folder(settings)
    wanted = sorted(set(range(len(campaign.sessions)) if sessions is None else sessions))
    simulate(campaign, folder, sessions=wanted, settings=settings, monitor=monitor)
    logs = campaign_logs(campaign, folder)
    return dict(zip(wanted, drives_of([logs[number] for number in wanted]), strict=True))


def map_path(campaign: Campaign, mapped: Sequence[int], settings: Settings) -> Path:
    """Where a map of some drives of a campaign is kept."""
    mapping = mapping_settings(settings)
    usual = Settings().for_descriptor(settings.frontend.descriptor)
    made = "" if mapping == usual else f"-{config_hash(mapping)[:8]}"
    name = f"map{'-'.join(map(str, mapped))}-{METHOD_VERSION}{made}.engram"
    return campaign_folder(towns_folder(settings), campaign) / name


def street(
    campaign: Campaign,
    mapped: Sequence[int],
    drives: dict[int, EvaluatedDrive],
    live: EvaluatedDrive,
    settings: Settings,
    lost_rounds: int = Budget().lost_rounds,
    *,
    same_town: bool = True,
) -> Street:
    """A map of some drives of a campaign, and a drive that is localised there."""
    path, some = map_path(campaign, mapped, settings), [drives[number] for number in mapped]
    return Street(path, some, live, settings, lost_rounds, same_town=same_town)


def streets(
    towns: Sequence[int],
    settings: Settings,
    lost_rounds: int,
    monitor: Monitor = QUIET,
    which: Sequence[tuple[tuple[int, ...], int]] = STREETS,
) -> Iterator[tuple[str, Street]]:
    """The streets of some towns by name; renders and maps what is not there yet."""
    for seed in towns:
        town = trial_town(seed)
        drives = drives_in(town, settings, monitor=monitor)
        for mapped, live in which:
            name = _name(seed, mapped, seed, drives[live])
            yield name, street(town, mapped, drives, drives[live], settings, lost_rounds)


def all_streets(
    towns: Sequence[int], settings: Settings, lost_rounds: int = 8
) -> Iterator[tuple[SessionPlan, str, Street]]:
    """Each map of each town with every drive that it was not built from: its plan, name, street."""
    for seed in towns:
        town = trial_town(seed)
        which = [(m, one.number) for m in _MAPPED for one in town.sessions if one.number not in m]
        found = streets([seed], settings, lost_rounds, QUIET, which)
        for (_, live), (name, made) in zip(which, found, strict=True):
            yield town.sessions[live], name, made


def other_towns(
    towns: Sequence[int], settings: Settings, lost_rounds: int, monitor: Monitor = QUIET
) -> Iterator[tuple[str, Street]]:
    """A drive of the next town in the map of each: nothing can be found there."""
    for seed, other in zip(towns, [*towns[1:], *towns[:1]], strict=True):
        if seed != other:
            town = trial_town(seed)
            drives = drives_in(town, settings, monitor=monitor)
            live = drives_in(trial_town(other), settings, monitor=monitor)[0]
            made = street(town, (2,), drives, live, settings, lost_rounds, same_town=False)
            yield _name(seed, (2,), other, live), made


def town_pairs(towns: Sequence[int], settings: Settings) -> Iterator[tuple[str, Street]]:
    """Each map of each town with every drive of every town that it was not built from."""
    for seed in towns:
        town = trial_town(seed)
        drives = drives_in(town, settings)
        for other in towns:
            for mapped in _MAPPED:
                for number, live in drives_in(trial_town(other), settings).items():
                    if seed != other or number not in mapped:
                        same = seed == other
                        made = street(town, mapped, drives, live, settings, 1, same_town=same)
                        yield _name(seed, mapped, other, live), made


def _name(seed: int, mapped: Sequence[int], other: int, live: EvaluatedDrive) -> str:
    return f"{seed}/{''.join(map(str, mapped))}/{other}-{live.name[:3]}"
