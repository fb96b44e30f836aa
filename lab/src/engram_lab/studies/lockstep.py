"""Many localisers over one drive in step: what does not depend on the policy is done once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from time import perf_counter, thread_time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from engram.frontend import Frame
from engram.geometry import SE3
from engram.graph.basin import DEFAULT_RADIUS_M
from engram.graph.model import NodeId
from engram.graph.neighbourhood import Neighbourhood, Search
from engram.localiser import Hint, Keeper, Localisation, Localiser, Matcher, Position
from engram.maps import Map
from engram.odometry import GapFiller, Motion, driven_steps_m
from engram.robot import Front, Robot, Settings
from engram.robot.localisers import LocaliserParts, localiser_in
from engram.sequences import LoggedFrame
from engram_lab.studies.configurations import EVERYTHING, Configuration
from engram_lab.studies.drives import EvaluatedDrive, Truth
from engram_lab.studies.in_force import Values, of_localiser
from engram_lab.studies.starting import TrueNodes


class SharedSearch:
    """A graph's own neighbourhood search that remembers this frame's answers.

    Localisers that matched the same node stand at the same position to the bit, whatever their
    policies: they ask the same.
    """

    def __init__(self, search: Callable[..., Neighbourhood]) -> None:
        self._search = search
        self._known: dict[tuple[object, ...], Neighbourhood] = {}

    def next_frame(self) -> None:
        """Forgets: another frame, other positions."""
        self._known.clear()

    def __call__(
        self,
        reference: int,
        reference_from_live: SE3,
        covariance: NDArray[np.float64],
        search: Search,
    ) -> Neighbourhood:
        """See `ExperienceGraph.neighbourhood`."""
        key = (
            reference,
            reference_from_live.translation.tobytes(),
            reference_from_live.rotation.tobytes(),
            covariance.tobytes(),
            search,
        )
        found = self._known.get(key)
        if found is None:
            found = self._search(reference, reference_from_live, covariance, search)
            self._known[key] = found
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """How one drive was localised by C configurations, F frames each.

    Attributes:
        configurations: the C configurations.
        step_m: (F,) float64, distance of the step that ends in the frame: by odometry, guessed
            where that failed.
        matched: (C, F) bool, whether the frame was localised.
        attempts: (C, F) int32, match attempts made.
        candidates: (C, F) int32, |Y|.
        succeeded: (C, F) int32, attempts that were accepted, also where the first one counts.
        near, near_seen: (C, F) int32, nodes truly within 8 m and 60° of a localised robot, and
            those of them that were candidates, in Y; counted for `EVERYTHING` only, else 0.
        offset_m, turn_rad: (C, F) float32, error of the pose of a success; NaN without one, or
            without truth.
        step_ms: (C,) float64, mean time of a frame; with a memo without the making of new matches.
        in_force: of each configuration, what its localiser ran by.
    """

    configurations: tuple[Configuration, ...]
    step_m: NDArray[np.float64]
    matched: NDArray[np.bool_]
    attempts: NDArray[np.int32]
    candidates: NDArray[np.int32]
    succeeded: NDArray[np.int32]
    near: NDArray[np.int32]
    near_seen: NDArray[np.int32]
    offset_m: NDArray[np.float32]
    turn_rad: NDArray[np.float32]
    step_ms: NDArray[np.float64]
    in_force: tuple[Values, ...]

    @staticmethod
    def empty(
        configurations: Sequence[Configuration],
        step_m: NDArray[np.float64],
        in_force: Sequence[Values] | None = None,
    ) -> Runs:
        """Nothing run yet."""
        shape = (len(configurations), len(step_m))
        return Runs(
            configurations=tuple(configurations),
            step_m=step_m,
            matched=np.zeros(shape, np.bool_),
            attempts=np.zeros(shape, np.int32),
            candidates=np.zeros(shape, np.int32),
            succeeded=np.zeros(shape, np.int32),
            near=np.zeros(shape, np.int32),
            near_seen=np.zeros(shape, np.int32),
            offset_m=np.full(shape, np.nan, np.float32),
            turn_rad=np.full(shape, np.nan, np.float32),
            step_ms=np.zeros(shape[0]),
            in_force=tuple(in_force or ({} for _ in configurations)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """One held-out drive and the map that it is localised in.

    Attributes:
        opened: the map, which stays as it is.
        drive: the drive.
        frames: its frames.
        start: number of the first frame that is localised, and the position there; None where
            no start is known.
        nodes: true poses of the map's nodes.
        truth: true poses of the drive; None where they are not known.
    """

    opened: Map
    drive: EvaluatedDrive
    frames: Sequence[LoggedFrame]
    start: tuple[int, Position] | None
    nodes: TrueNodes
    truth: Truth | None


class _Running(NamedTuple):
    """One configuration's robot, and its localiser."""

    robot: Robot
    localiser: Localiser


def run_in_step(
    situation: Situation,
    configurations: Sequence[Configuration],
    settings: Settings,
    matcher: Matcher | None,
    relocaliser: str | None = None,
    cost_so_far: Callable[[], float] = lambda: 0.0,
    threads: int | None = None,
) -> Runs:
    """Localises the drive with every configuration, frame by frame.

    Args:
        situation: drive and map.
        configurations: what to run.
        settings: the resolved configuration.
        matcher: makes the matches, unguided; None for the localiser's own, guided ones.
        relocaliser: key of `RELOCALISERS`; None leaves the lost to what is near.
        cost_so_far: seconds spent in making matches; left out of `step_ms`.
        threads: most threads that a robot's lanes share; None for one each.
    """
    frames = situation.frames
    # With a memo everything runs on this thread, beside other workers on a busy machine; as on a
    # robot, on several threads, the time until the answer counts.
    clock = perf_counter if matcher is None else thread_time
    gaps = GapFiller(settings.gaps)
    motions = [
        gaps.motion(one.odometry, one.frame.stamp_ns, landmarks=len(one.frame.landmarks))
        for one in frames
    ]
    step_m = driven_steps_m(motions, [one.frame.stamp_ns for one in frames])
    search = SharedSearch(situation.opened.graph.neighbourhood)
    parts = LocaliserParts(
        matcher=matcher,
        search=search,
        relocaliser=relocaliser,
        threads=threads,
        live=situation.drive.session.id,
        clock=situation.drive.session,
    )
    with _robots(situation, configurations, settings, parts) as running:
        runs = Runs.empty(
            configurations,
            step_m,
            [of_localiser(one.localiser, gaps, situation.drive, matcher) for one in running],
        )
        for number, logged in enumerate(frames):
            if situation.start is None or number < situation.start[0]:
                for one in running:
                    one.robot.follow(logged, motion=motions[number])
                continue
            search.next_frame()
            judge = _Judge(situation, logged.frame)
            for row, one in enumerate(running):
                started, made = clock(), cost_so_far()
                found = one.robot.step(logged, motion=motions[number])
                seconds = clock() - started - (cost_so_far() - made)
                runs.step_ms[row] += 1e3 * seconds
                _note(runs, row, number, found, one.localiser, judge)
    runs.step_ms[:] /= max(len(frames), 1)
    return runs


def _note(
    runs: Runs, row: int, number: int, found: Localisation, localiser: Localiser, judge: _Judge
) -> None:
    """Writes down how one configuration localised one frame."""
    runs.matched[row, number] = found.node is not None
    runs.attempts[row, number] = found.attempts
    runs.candidates[row, number] = found.candidates
    runs.succeeded[row, number] = sum(one.accepted for one in localiser.attempted)
    if found.node is None or found.node_from_live is None:
        return
    error = judge.error(found.node, found.node_from_live)
    runs.offset_m[row, number], runs.turn_rad[row, number] = error
    candidates = localiser.neighbourhood
    if runs.configurations[row] == EVERYTHING and candidates is not None:
        near = judge.near()
        seen = {localiser.graph.node(int(index)).id for index in candidates.nodes}
        runs.near[row, number] = len(near)
        runs.near_seen[row, number] = len(near & seen)


class _Placing(Keeper):
    """Supplies where the drive starts, and keeps nothing."""

    def __init__(self, situation: Situation) -> None:
        self._start = situation.start
        if self._start is not None:
            self._stamp_ns = situation.frames[self._start[0]].frame.stamp_ns

    def hint(self, live: Frame, motion: Motion) -> Hint | None:
        """See `Keeper`."""
        del motion
        if self._start is None or live.stamp_ns != self._stamp_ns:
            return None
        return Hint(self._start[1])


class _Judge:
    """Errors of one frame's poses; several configurations often have the same."""

    def __init__(self, situation: Situation, live: Frame) -> None:
        self._nodes = situation.nodes
        truth = situation.truth
        self._world_from_live = None if truth is None else truth.at(live.stamp_ns)
        self._known: dict[tuple[NodeId, bytes], tuple[float, float]] = {}

    def near(self) -> set[NodeId]:
        """The nodes that should be candidates; none where truth is not known."""
        if self._world_from_live is None:
            return set()
        return self._nodes.near(self._world_from_live, DEFAULT_RADIUS_M)

    def error(self, node: NodeId, node_from_live: SE3) -> tuple[float, float]:
        """Metres and radians; NaN where truth is not known."""
        world_from_node = self._nodes.pose(node)
        if self._world_from_live is None or world_from_node is None:
            return np.nan, np.nan
        key = (node, node_from_live.translation.tobytes())
        if key not in self._known:
            true = world_from_node.inverse() @ self._world_from_live
            offset_m = float(np.linalg.norm(node_from_live.translation - true.translation))
            self._known[key] = offset_m, (true.inverse() @ node_from_live).angle_rad
        return self._known[key]


@contextmanager
def _robots(
    situation: Situation,
    configurations: Iterable[Configuration],
    settings: Settings,
    parts: LocaliserParts,
) -> Iterator[list[_Running]]:
    """One per configuration; in one map they share its matches."""
    with ExitStack() as stack:
        keeper, running = _Placing(situation), list[_Running]()
        for one in configurations:
            own: LocaliserParts = {**parts, "policy": one.policy, "budget": one.budget}
            asked = _settings_for(settings, one, guided=parts["matcher"] is None)
            localiser = localiser_in(situation.opened, situation.drive.camera, asked, **own)
            # Each has a front of its own, which tells time by the frames that it takes.
            robot = stack.enter_context(Robot(Front(settings), localiser, keeper))
            running.append(_Running(robot, localiser))
        yield running


def _settings_for(settings: Settings, configuration: Configuration, *, guided: bool) -> Settings:
    localiser = configuration.settings_over(settings.localiser)
    if not guided:
        localiser = replace(localiser, guide_below_m=0.0)
    return replace(settings, localiser=localiser)
