"""Many localisers over one drive in step; their results on disk, and matches made once for all.

Matches of one live session that were made once and are used by every policy (method §8).
`match(live, node)` is a pure function of two frames and the matcher's configuration, so that its
results may be kept: unguided, by (live UUID, node UUID, matcher hash). Whether a match is accepted
depends on each policy's own prediction and is judged afresh.
"""

from __future__ import annotations

import json
import os
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any, NamedTuple
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import Frame
from engram.frontend.matching import Match, matcher_hash
from engram.geometry.se3 import SE3
from engram.graph.basin import DEFAULT_RADIUS_M
from engram.graph.model import NodeId, node_id
from engram.graph.neighbourhood import Neighbourhood, Search
from engram.localiser.acceptance import AcceptanceConfig, Prediction, Spread, accept
from engram.localiser.attempts import Candidate, Lanes, Matcher, one_by_one
from engram.localiser.localisation import (
    Hint,
    Localisation,
    LocalisationStatus,
    Position,
    ResultSink,
)
from engram.localiser.localiser import Localiser
from engram.maps.map import Map
from engram.odometry.motion import GapFiller, Motion, driven_steps_m
from engram.robot.front import Front
from engram.robot.localisers import LocaliserParts, localiser_in
from engram.robot.robot import Robot
from engram.robot.settings import Settings
from engram.sequences.sequence import LoggedFrame
from engram_lab.studies.configurations import BY_TRUTH, EVERYTHING, Configuration
from engram_lab.studies.drives import EvaluatedDrive, TrueNodes, Truth
from engram_lab.studies.in_force import Values, of_localiser


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
        rank_ms: (C,) float64, median time of ranking the candidates of a frame.
        attempt_ms: (C,) float64, mean processor time of a match that was made; NaN where a memo
            had them all.
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
    rank_ms: NDArray[np.float64]
    attempt_ms: NDArray[np.float64]
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
            rank_ms=np.zeros(shape[0]),
            attempt_ms=np.full(shape[0], np.nan),
            in_force=tuple(in_force or ({} for _ in configurations)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """One held-out drive and the map that it is localised in.

    Attributes:
        start: number of the first frame that is localised, and the position there; None where
            no start is known.
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
        matcher: makes the matches, unguided; None for the localiser's own, guided ones.
        relocaliser: as of `StudyOptions`; None leaves the lost to what is near.
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
        relocaliser=None if relocaliser == BY_TRUTH else relocaliser,
        threads=threads,
        live=situation.drive.session.id,
        clock=situation.drive.session,
    )
    perfect = None
    if relocaliser == BY_TRUTH:
        config = settings.localiser
        made_by = matcher or Lanes(situation.opened.frames, config.matcher)
        perfect = ByTruth(situation, made_by, config.acceptance)
    with _robots(situation, configurations, settings, parts, perfect) as running:
        runs = Runs.empty(
            configurations,
            step_m,
            [of_localiser(one.localiser, gaps, situation.drive, matcher) for one in running],
        )
        rank_ms = np.zeros((len(running), len(frames)))
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
                rank_ms[row, number] = found.stage_ms.get("rank", 0.0)
                _note(runs, row, number, found, one.localiser, judge)
    runs.step_ms[:] /= max(len(frames), 1)
    runs.rank_ms[:] = np.median(rank_ms, axis=1) if frames else 0.0
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


class Placing(ResultSink):
    """Supplies where the drive starts, and keeps nothing.

    Args:
        relocaliser: finds the robot at the start and wherever it is lost; None for none.
    """

    def __init__(self, situation: Situation, relocaliser: ByTruth | None = None) -> None:
        self._start = situation.start
        self._relocaliser = relocaliser
        self._lost = False
        if self._start is not None:
            self._stamp_ns = situation.frames[self._start[0]].frame.stamp_ns

    def hint(self, live: Frame, motion: Motion) -> Hint | None:
        """See `ResultSink`."""
        del motion
        starts = self._start is not None and live.stamp_ns == self._stamp_ns
        found = None
        if self._relocaliser is not None and (starts or self._lost):
            found = self._relocaliser.find(live)
        if found is not None:
            return Hint(found, agreed=1)
        return Hint(self._start[1]) if self._start is not None and starts else None

    def keep(self, live: Frame, result: Localisation) -> Localisation:
        """See `ResultSink`."""
        del live
        self._lost = result.status is LocalisationStatus.LOST
        return result


class ByTruth:
    """A relocaliser that finds whatever can be found: the nearest node by truth that matches.

    Stands for [L15] §VII-B's, which after 10 m without a match looks for a place that looks alike.
    One for all robots of a drive: those that are lost at one frame are found alike.
    """

    def __init__(self, situation: Situation, matcher: Matcher, config: AcceptanceConfig) -> None:
        self._situation = situation
        self._matcher = matcher
        self._config = config
        self._found: tuple[int, Position | None] | None = None

    def find(self, live: Frame) -> Position | None:
        """Where the robot is; None where no node near it matches, or its true pose is unknown."""
        if self._found is None or self._found[0] != live.stamp_ns:
            self._found = live.stamp_ns, self._search(live)
        return self._found[1]

    def _search(self, live: Frame) -> Position | None:
        truth, session = self._situation.truth, self._situation.drive.session.id
        world_from_live = None if truth is None else truth.at(live.stamp_ns)
        if world_from_live is None:
            return None
        live_id = node_id(session, live.stamp_ns)
        for there in self._situation.nodes.seen_from(world_from_live, DEFAULT_RADIUS_M):
            match = self._matcher.match(live, live_id, there.node, None)
            expected = Prediction(there.node_from_live, 0.0, 0.0)
            if accept(match, expected, self._config):
                return there
        return None


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
    relocaliser: ByTruth | None,
) -> Iterator[list[_Running]]:
    """One per configuration; in one map they share its matches."""
    with ExitStack() as stack:
        running = list[_Running]()
        for one in configurations:
            own: LocaliserParts = {**parts, "policy": one.policy, "budget": one.budget}
            asked = _settings_for(settings, one, guided=parts["matcher"] is None)
            localiser = localiser_in(situation.opened, situation.drive.camera, asked, **own)
            # Each has a front of its own, which tells time by the frames that it takes.
            placing = Placing(situation, relocaliser)
            robot = stack.enter_context(Robot(Front(settings), localiser, placing))
            running.append(_Running(robot, localiser))
        yield running


def _settings_for(settings: Settings, configuration: Configuration, *, guided: bool) -> Settings:
    localiser = configuration.settings_over(settings.localiser)
    if not guided:
        localiser = replace(localiser, guide_below_m=0.0)
    return replace(settings, localiser=localiser)


_STORE_VERSION = 4
# What NumPy, zip and JSON say of damaged files.
UNREADABLE = (
    OSError,
    EOFError,
    ValueError,
    LookupError,
    TypeError,
    SyntaxError,
    NotImplementedError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
_LISTS = {"configurations", "in_force"}
_PER_FRAME = [one.name for one in fields(Runs) if one.name not in _LISTS | {"step_m"}]


def read_runs(path: Path) -> Runs | None:
    """What was run of a session; None where nothing was, or the file is of no use."""
    if not path.exists():
        return None
    try:
        with np.load(path) as kept:
            if int(kept["kind"][0]) != _STORE_VERSION:
                return None
            plain = json.loads(str(kept["configurations"][0]))
            in_force = json.loads(str(kept["in_force"][0]))
            columns: dict[str, Any] = {name: kept[name] for name in _PER_FRAME}
            return Runs(
                tuple(Configuration.from_dict(one) for one in plain),
                kept["step_m"],
                in_force=tuple(dict(one) for one in in_force),
                **columns,
            )
    except UNREADABLE:
        return None


def write_runs(path: Path, runs: Runs) -> None:
    """In one step: a killed run leaves what was there."""
    plain = [one.to_dict() for one in runs.configurations]
    draft = path.with_name(f".{path.name}.{os.getpid()}.npz")
    np.savez_compressed(
        draft,
        kind=np.array([_STORE_VERSION]),
        configurations=np.array([json.dumps(plain)]),
        in_force=np.array([json.dumps(runs.in_force)]),
        step_m=runs.step_m,
        **{name: getattr(runs, name) for name in _PER_FRAME},
    )
    draft.replace(path)


def joined(first: Runs | None, second: Runs) -> Runs:
    """Both; the second's where both have run a configuration."""
    if first is None:
        return second
    kept = only(first, set(first.configurations) - set(second.configurations))
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(kept, name), getattr(second, name)]) for name in _PER_FRAME
    }
    return Runs(
        kept.configurations + second.configurations,
        second.step_m,
        in_force=kept.in_force + second.in_force,
        **columns,
    )


def only(runs: Runs, wanted: Collection[Configuration]) -> Runs:
    """Some of the configurations, in the order in which they stand."""
    rows = [row for row, one in enumerate(runs.configurations) if one in wanted]
    columns: dict[str, Any] = {name: getattr(runs, name)[rows] for name in _PER_FRAME}
    return replace(
        runs,
        configurations=tuple(runs.configurations[row] for row in rows),
        in_force=tuple(runs.in_force[row] for row in rows),
        **columns,
    )


def missing(runs: Runs | None, wanted: Iterable[Configuration]) -> list[Configuration]:
    """What is wanted and was not run."""
    done = set() if runs is None else set(runs.configurations)
    return [one for one in dict.fromkeys(wanted) if one not in done]


_MEMO_VERSION = 1
_NO_ROWS = np.empty(0, dtype=np.int32)
_NO_MATCH = Match(None, None, 0, _NO_ROWS, _NO_ROWS)


class MatchMemo:
    """A `Matcher` that asks another one only for what it does not contain.

    What it gives back has no rows of landmarks: nobody behind the matcher looks at them.
    """

    def __init__(self, matcher: Matcher, path: Path, matcher_hash: str) -> None:
        self._matcher = matcher
        self._path = path
        self._hash = matcher_hash
        self._frames: dict[int, dict[NodeId, Match]] = {}
        self._spreads: dict[tuple[int, NodeId], Spread] = {}
        self.made = 0
        self.seconds = 0.0
        self._read()

    @staticmethod
    def of(opened: Map, drive: EvaluatedDrive, settings: Settings, folder: Path) -> MatchMemo:
        """The memo that is kept in a folder of one drive in maps of the same nodes."""
        config = settings.localiser.matcher
        path = folder / f"memo-{drive.key}.matches.npz"
        return MatchMemo(Lanes(opened.frames, config), path, matcher_hash(config))

    @property
    def known(self) -> int:
        """Pairs of frame and node whose result is stored, found or not."""
        return sum(len(matches) for matches in self._frames.values())

    def match(self, live: Frame, live_id: NodeId, node: NodeId, guide: Prediction | None) -> Match:
        """See `Matcher`; a guided match depends on its prediction and is not kept."""
        if guide is not None:
            return self._matcher.match(live, live_id, node, guide)
        known = self._frames.get(live.stamp_ns)
        if known is None:
            known = self._frames[live.stamp_ns] = {}
        match = known.get(node)
        if match is None:
            match = known[node] = self._make(live, live_id, node)
        return match

    def matches(
        self, live: Frame, live_id: NodeId, candidates: Sequence[Candidate]
    ) -> list[Match | None]:
        """See `Matcher`."""
        return one_by_one(self, live, live_id, candidates)

    def spread(self, live: Frame, live_id: NodeId, node: NodeId, match: Match) -> Spread:
        """See `Matcher`."""
        if match.reference_from_live is None:
            return Spread(0.0, 0.0, 0.0)
        key = (live.stamp_ns, node)
        if key not in self._spreads:
            started = thread_time()
            whole = self._matcher.match(live, live_id, node, None)
            self._spreads[key] = self._matcher.spread(live, live_id, node, whole)
            self.seconds += thread_time() - started
        return self._spreads[key]

    def prefetch(self, nodes: list[NodeId]) -> None:
        """See `Matcher`; most of them are stored."""

    def _make(self, live: Frame, live_id: NodeId, node: NodeId) -> Match:
        started = thread_time()
        match = self._matcher.match(live, live_id, node, None)
        self.made += 1
        self.seconds += thread_time() - started
        if match.reference_from_live is None:
            return _NO_MATCH
        return Match(match.reference_from_live, match.covariance, match.inliers, _NO_ROWS, _NO_ROWS)

    def save(self) -> None:
        """Writes all results, in one step: a killed run leaves the file as it was."""
        nodes = sorted({node for known in self._frames.values() for node in known})
        number = {node: k for k, node in enumerate(nodes)}
        rows = [
            (stamp_ns, number[node], match)
            for stamp_ns, known in self._frames.items()
            for node, match in known.items()
        ]
        posed = [match for _, _, match in rows if match.reference_from_live is not None]
        draft = self._path.with_name(f".{self._path.name}.{os.getpid()}.npz")
        np.savez(
            draft,
            kind=np.array([_MEMO_VERSION]),
            matcher=np.array([self._hash]),
            nodes=np.frombuffer(b"".join(node.bytes for node in nodes), np.uint8).reshape(-1, 16),
            stamp_ns=np.array([row[0] for row in rows], np.int64),
            node=np.array([row[1] for row in rows], np.int32),
            inliers=np.array([row[2].inliers for row in rows], np.int32),
            pose=np.array([_pose_row(match) for match in posed], np.float64).reshape(-1, 12),
            covariance=np.array([match.covariance for match in posed]).reshape(-1, 6, 6),
        )
        draft.replace(self._path)

    def _read(self) -> None:
        if not self._path.exists():
            return
        try:
            with np.load(self._path) as kept:
                if int(kept["kind"][0]) == _MEMO_VERSION and str(kept["matcher"][0]) == self._hash:
                    self._fill({name: kept[name] for name in kept.files})
        except UNREADABLE:
            self._frames = {}

    def _fill(self, kept: dict[str, NDArray[Any]]) -> None:
        nodes = [NodeId(UUID(bytes=row.tobytes())) for row in kept["nodes"]]
        poses, covariances, used = kept["pose"], kept["covariance"], 0
        rows = zip(
            kept["stamp_ns"].tolist(), kept["node"].tolist(), kept["inliers"].tolist(), strict=True
        )
        for stamp_ns, node, inliers in rows:
            match = _NO_MATCH
            if inliers > 0:
                pose = poses[used]
                transform = SE3(pose[:9].reshape(3, 3), pose[9:])
                match = Match(transform, covariances[used], inliers, _NO_ROWS, _NO_ROWS)
                used += 1
            self._frames.setdefault(stamp_ns, {})[nodes[node]] = match


def _pose_row(match: Match) -> NDArray[np.float64]:
    assert match.reference_from_live is not None
    pose = match.reference_from_live
    return np.concatenate([pose.rotation.ravel(), pose.translation])
