"""Robots with a wrong position, and attempts at places where a robot is not.

Attempts at places where a robot is not: every node of a map that is far from it, or elsewhere. Few
robots that are misplaced by chance meet a place that looks alike. Here each frame of a drive is
matched with each node at least `OFF_M` away, as by a lost robot. Where landmarks agree on a pose
all the same, robots are told to be there, or carried to the frame from there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.geometry.se3 import SE3
from engram.graph.model import NodeId, node_id
from engram.localiser.acceptance import Prediction
from engram.localiser.attempts import Attempter, Candidate, Outcome
from engram.localiser.confidence import UNKNOWN, Standing
from engram.localiser.localisation import Budget, Localisation, Position
from engram.maps.map import Map, open_map
from engram.odometry.outside import OutsideMotion
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.front import Front
from engram.robot.localisers import localiser_in
from engram.robot.robot import Robot
from engram.robot.settings import Settings
from engram.sequences.sequence import LoggedFrame
from engram_lab.studies.building import GENEROUS, build_map, true_nodes
from engram_lab.studies.drives import EvaluatedDrive

# A fix further from the truth is false.
FALSE_M = 1.0
# A fix claims to be sure from this confidence on.
SURE = 7.0
FALSE_RAD = float(np.deg2rad(5.0))
# A robot is misplaced by at least this much, told so with these standard deviations.
OFF_M = 15.0
SIGMAS_M = (0.1, 1.0, 3.0)
SIGMA_RAD = float(np.deg2rad(2.0))
# Frames that a robot drives before it is carried elsewhere, and after.
_BEFORE, FRAMES = 15, 40


class Kind(StrEnum):
    """What happens to a robot."""

    UNDISTURBED = "undisturbed"
    COLD = "cold start"
    TOLD = "told a wrong place"
    CARRIED = "carried elsewhere"
    GAP = "past a gap"
    LOST = "lost"


# Such robots drive to the end.
_TO_THE_END = frozenset({Kind.UNDISTURBED, Kind.COLD})


@dataclass(frozen=True, slots=True)
class Try:
    """One robot.

    Attributes:
        kind: what happens to it.
        first: its first frame, or that after a gap or where it was carried to; undisturbed robots
            and those that start lost drive on to the end of the drive.
        sigma_m: of a wrong place that it is told; 0 else.
        seed: of where it is told to be, or was carried from.
    """

    kind: Kind
    first: int
    sigma_m: float = 0.0
    seed: int = 0

    @property
    def key(self) -> tuple[str, int, float, int]:
        """What identifies it."""
        return self.kind.value, self.first, self.sigma_m, self.seed


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """One frame of such a robot.

    Attributes:
        found: the result.
        outcomes: of its attempts.
        frame: its number in the drive.
        counts: whether it is one of the `FRAMES` after what happened.
    """

    found: Localisation
    outcomes: list[Outcome]
    frame: int
    counts: bool


class Street:
    """A map and a drive in the same town, with truth.

    Args:
        path: where the map is kept; built if it is not there.
        mapped: the drives that it is built from.
        live: the drive to be localised.
        settings: the configuration.
        lost_rounds: budget of a lost robot.
        same_town: whether the drive is one of the map's town; else every pose is false.
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
        self.opened: Map = open_map(build_map(path, mapped, settings, GENEROUS).path)
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
        return None if error is None else error[0] > FALSE_M or error[1] > FALSE_RAD

    def run(
        self,
        one: Try,
        *,
        relocalises: bool = True,
        outside: Sequence[OutsideMotion | None] | None = None,
    ) -> Iterator[Looked]:
        """Drives the robot, frame by frame.

        Args:
            one: what happens to it.
            relocalises: whether it looks for itself elsewhere.
            outside: what its wheels and gyroscope measure before each frame of the drive, of a
                robot that is shown all frames; None without them.
        """
        localiser = localiser_in(
            self.opened,
            self.live.camera,
            self.settings,
            budget=self._budget,
            relocaliser="fabmap" if relocalises else None,
            live=self.live.session.id,
            threads=1,
        )
        with Robot(Front(self.settings), localiser) as robot:
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
        sigmas = [SIGMAS_M[k % 3] if kind is Kind.TOLD else 0.0 for k in range(count)]
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
        if one.kind is not Kind.TOLD:
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
        runs on: stamps before are moved to where it was carried to.
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


@dataclass(frozen=True, slots=True, eq=False)
class WrongPlace:
    """An attempt at a node where the robot is not.

    Attributes:
        frame: number of the live frame.
        outcome: of the attempt.
    """

    frame: int
    outcome: Outcome


class WrongPlaces:
    """All attempts of a drive at the nodes of a map that are elsewhere.

    Args:
        street: the map and the drive.
        every: frames from one that is tried to the next.

    Attributes:
        attempts: how many attempts were made so far.
    """

    def __init__(self, street: Street, every: int = 1) -> None:
        self._street, self._every = street, every
        opened, config = street.opened, street.settings.localiser
        self._config = config
        self._attempter = Attempter(opened.frames, config)
        self._nodes = opened.graph.nodes
        self.attempts = 0

    def lost(self) -> Iterator[WrongPlace]:
        """As by a lost robot, without a prediction; those of `LEAST_INLIERS` and a pose."""
        for frame in range(0, len(self._street.frames), self._every):
            for index in self._elsewhere(frame):
                self.attempts += 1
                outcome = self._attempt(frame, index, None, UNKNOWN)
                if self._is_wrong(frame, outcome):
                    yield WrongPlace(frame, outcome)

    def believed(self, there: WrongPlace, usual_inliers: float = 0.0) -> Iterator[WrongPlace]:
        """As by robots whose position is where such a match is, with each deviation.

        Args:
            there: the match.
            usual_inliers: of the fixes of a robot that was carried; 0 for one that was told so.
        """
        pose, index = there.outcome.match.reference_from_live, there.outcome.candidate.index
        assert pose is not None
        rng = np.random.default_rng([there.frame, index])
        for sigma_m in SIGMAS_M:
            off = np.concatenate([rng.normal(0.0, sigma_m, 3), rng.normal(0.0, SIGMA_RAD, 3)])
            prediction = Prediction(pose @ SE3.exp(off), sigma_m, SIGMA_RAD)
            missed = float(rng.uniform(0.0, _MOST_MISSED))
            standing = Standing(missed=missed)
            if usual_inliers:
                tracked = float(self._tracked[there.frame])
                standing = Standing(_CONFIRMED, missed, usual_inliers, tracked)
            self.attempts += 1
            outcome = self._attempt(there.frame, index, prediction, standing)
            if self._is_wrong(there.frame, outcome):
                yield WrongPlace(there.frame, outcome)

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
