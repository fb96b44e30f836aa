"""The drives that an evaluation runs on, in folds, and where each starts in a map (method §8)."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from shlex import quote

import numpy as np
from numpy.typing import NDArray

from engram.config import config_hash
from engram.errors import ConfigError, SequenceError
from engram.frontend.frame import DescriptorKind, FrameStatus
from engram.frontend.frontend import FrontendConfig
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.basin import DEFAULT_RADIUS_M
from engram.graph.graph import ExperienceGraph
from engram.graph.model import NodeId, Session, SessionId, node_id
from engram.localiser.acceptance import AcceptanceConfig, accept_lost
from engram.localiser.attempts import Matcher
from engram.localiser.localisation import Position
from engram.maps.frame_reader import DEFAULT_CACHE_BYTES
from engram.maps.map import Map
from engram.robot.localisers import session_of_drive
from engram.robot.settings import Settings
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.motion_files import Trajectory
from engram.sequences.sequence import LoggedFrame
from engram_lab.town.campaigns import WORLD_VERSION, Campaign, Size, campaign_named
from engram_lab.town.simulating import Upkeep, bring_up_to_date, campaign_folder, known_frontends
from engram_lab.truth import read_truth, truth_path


@dataclass(frozen=True, slots=True)
class EvaluatedDrive:
    """One drive, recorded as a frame log.

    Attributes:
        truth_hash: of its true poses, which stand beside it; None where there are none. Those of
            all drives of an evaluation are in one world frame.
        world: version of the simulated world that it was rendered in; None for other drives.
        landmarks: of each frame, the first so many of those that the log keeps; None for the
            front-end's own.
    """

    path: Path
    session: Session
    camera: StereoCamera
    descriptor: DescriptorKind
    frontend: str
    odometry: str
    truth_hash: str | None
    world: int | None = None
    landmarks: int | None = None

    @property
    def name(self) -> str:
        """For people; several drives may have the same."""
        return self.path.stem

    @property
    def key(self) -> str:
        """For files and tasks: no two drives of an evaluation have the same."""
        return f"{self.name}-{self.session.id.hex[-12:]}"

    @property
    def has_truth(self) -> bool:
        """Whether its true poses are known."""
        return self.truth_hash is not None

    def log(self) -> FrameLog:
        """Its frame log, to be closed by the caller."""
        return FrameLog(self.path, landmarks=self.landmarks)

    def frames(self) -> list[LoggedFrame]:
        """All its frames, in memory."""
        log = self.log()
        try:
            return list(log)
        finally:
            log.close()

    def truth(self) -> Truth | None:
        """Its true poses; None where they are not known."""
        return None if self.truth_hash is None else _truth(self.path, self.truth_hash)


class Truth:
    """True poses of one drive's frames, by stamp."""

    def __init__(self, trajectory: Trajectory) -> None:
        self._poses = dict(
            zip(trajectory.stamps_ns.tolist(), trajectory.world_from_cam, strict=True)
        )

    def at(self, stamp_ns: int) -> SE3 | None:
        """``world_from_cam`` of the frame with this very stamp; None if it has none."""
        return self._poses.get(stamp_ns)


@lru_cache(maxsize=256)
def _truth(path: Path, content: str) -> Truth | None:
    del content  # another content is another truth to remember
    trajectory = read_truth(path)
    return None if trajectory is None else Truth(trajectory)


@dataclass(frozen=True, slots=True)
class DriveSet:
    """What is evaluated together."""

    name: str
    drives: tuple[EvaluatedDrive, ...]

    @staticmethod
    def of(drives: tuple[EvaluatedDrive, ...]) -> DriveSet:
        """Drives of one's own, named after the first and the last.

        Names that are mere numbers say nothing; their folder's does.
        """
        first, last = (drives[at].path for at in (0, -1))
        if first.stem.isdecimal():
            return DriveSet(first.resolve().parent.name or "logs", drives)
        return DriveSet(f"{first.stem}-to-{last.stem}", drives)

    @property
    def has_truth(self) -> bool:
        """Whether all drives have their truth next to them."""
        return all(drive.has_truth for drive in self.drives)

    @property
    def hash(self) -> str:
        """Changes with any drive, what made it, and its truth: what caches are kept by."""
        return config_hash(
            {
                str(one.session.id): (one.frontend, one.odometry, one.truth_hash)
                for one in self.drives
            }
        )


def open_campaign(
    text: str,
    campaigns: Path,
    size: Size = Size.STANDARD,
    settings: Settings | None = None,
    first: int | None = None,
) -> DriveSet:
    """A rendered campaign, by ``NAME`` or ``NAME@SEED`` of its town.

    Args:
        first: only so many drives, the earliest; None for all.
    """
    name, _, seed = text.partition("@")
    try:
        number = int(seed or 1)
    except ValueError:
        raise ConfigError(f"campaign {text!r}: the seed after @ must be a whole number") from None
    campaign = campaign_named(name, number, size)
    paths = campaign_logs(campaign, campaigns)[:first]
    missing = [path for path in paths if not path.exists()]
    if missing:
        raise SequenceError(
            f"campaign {text!r}: {len(missing)} of {len(paths)} sessions are not rendered (the "
            f"first is {missing[0]}); run: engram lab simulate {campaign.home} --seed "
            f"{campaign.seed} --size {size.value} --out {quote(str(campaigns))}"
        )
    settings = settings or Settings()
    drives, ours = drives_of(paths), known_frontends(settings)
    same = [one.path for one in drives if one.frontend in ours]
    if {bring_up_to_date(path, settings) for path in same} - {Upkeep.KEPT}:
        drives = drives_of(paths)
    name = text if first is None else f"{text} (first {len(paths)})"
    return DriveSet(name, tuple(replace(one, world=WORLD_VERSION) for one in drives))


def seen_by(drives: DriveSet, settings: Settings) -> DriveSet:
    """The drives, each frame with as many landmarks as the settings ask for.

    Logs keep more of them than the front-end asks for, in its order: the first are to the bit those
    of a front-end that asks for no more.

    Raises:
        ConfigError: other than the usual number is asked for, and a log keeps no order of them.
    """
    wanted = settings.frontend.landmarks
    if wanted == FrontendConfig().landmarks:
        return drives
    seen = tuple(replace(one, landmarks=wanted) for one in drives.drives)
    for drive in seen:
        with closing(drive.log()) as log:
            found = len(log.read(0).frame.landmarks)
        if found > wanted:
            raise ConfigError(
                f"frontend.landmarks is {wanted}, and {drive.path} keeps {found} without saying "
                "which come first: leave it out, or record the drive with more"
            )
    return replace(drives, drives=seen)


def campaign_logs(campaign: Campaign, campaigns: Path) -> list[Path]:
    """Where the frame logs of a campaign's sessions stand, rendered or not."""
    folder = campaign_folder(campaigns, campaign)
    return [folder / f"{plan.name}.framelog" for plan in campaign.sessions]


def drives_of(paths: Sequence[Path]) -> tuple[EvaluatedDrive, ...]:
    """Frame logs as drives, in the order of time."""
    drives = sorted((_drive(path) for path in paths), key=lambda d: (d.session.start_ns, d.name))
    by_id: dict[object, EvaluatedDrive] = {}
    for drive in drives:
        other = by_id.setdefault(drive.session.id, drive)
        if other is not drive:
            raise SequenceError(f"{drive.path} and {other.path} are the same drive; give it once")
    kinds = {drive.descriptor for drive in drives}
    if len(kinds) > 1:
        raise SequenceError(
            f"the logs have descriptors of several kinds ({', '.join(sorted(kinds))}), which "
            "cannot be matched; extract them with one front-end"
        )
    return tuple(drives)


def _drive(path: Path) -> EvaluatedDrive:
    if path.suffix != ".framelog":
        raise SequenceError(f"{path}: is not a frame log; make one with: engram record {path}")
    log = FrameLog(path)
    try:
        if not log.complete:
            raise SequenceError(f"{path}: was not recorded to its end; give the same command again")
        drive = EvaluatedDrive(
            path,
            session_of_drive(log),
            log.camera,
            log.header.descriptor,
            log.header.frontend,
            log.header.odometry,
            _hash_of(truth_path(path)),
        )
    finally:
        log.close()
    drive.truth()  # what is wrong with it is to be told now, not once a map is built
    return drive


def _hash_of(path: Path) -> str | None:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SequenceError(f"{path}: cannot be read: {error.strerror or error}") from error


@dataclass(frozen=True, slots=True)
class Fold:
    """One division of the sessions; numbers are places in the order of time.

    Attributes:
        number: 0, 1, ….
    """

    number: int
    training: tuple[int, ...]
    held_out: tuple[int, ...]


def split(sessions: int, folds: int = 5, seed: int = 0) -> tuple[Fold, ...]:
    """Every session is held out once; seeded shuffle, sizes within one. Source: method §8."""
    if not 2 <= folds <= sessions:
        raise ConfigError(
            f"cannot split {sessions} sessions into {folds} folds; there must be at least 2 folds "
            "and as many sessions as folds"
        )
    shuffled = np.random.default_rng(seed).permutation(sessions)
    parts = [tuple(sorted(part.tolist())) for part in np.array_split(shuffled, folds)]
    everyone = range(sessions)
    return tuple(
        Fold(number, tuple(one for one in everyone if one not in part), part)
        for number, part in enumerate(parts)
    )


def chosen_folds(folds: tuple[Fold, ...], only: tuple[int, ...]) -> tuple[Fold, ...]:
    """Some folds by their numbers; all where none is named."""
    return tuple(folds[number] for number in sorted(set(only))) if only else folds


def check_only(only: tuple[int, ...], folds: int) -> None:
    """Whether some requested folds exist."""
    strange = [one for one in only if not 0 <= one < folds]
    if strange:
        raise ConfigError(
            f"folds {strange} are requested; {folds} folds are numbered from 0 to {folds - 1}"
        )


# What an operator who sets a robot down knows of its place.
_SIGMA_M = 0.25
_SIGMA_RAD = float(np.deg2rad(1.0))
_VIEW_GATE_RAD = float(np.deg2rad(60.0))  # as for candidates, method §3.1


class TrueNodes:
    """True poses of a map's nodes."""

    def __init__(self, opened: Map, truths: Mapping[SessionId, Truth | None]) -> None:
        self._poses: dict[NodeId, SE3] = {}
        for node in opened.graph.nodes:
            truth = truths.get(node.session)
            pose = None if truth is None else truth.at(node.stamp_ns)
            if pose is not None:
                self._poses[node.id] = pose
        self._ids = list(self._poses)
        self._in_main = _in_largest_component(opened.graph, self._ids)
        poses = list(self._poses.values())
        self._positions = np.array([pose.translation for pose in poses]).reshape(-1, 3)
        self._headings = np.array([pose.rotation[:, 2] for pose in poses]).reshape(-1, 3)

    def pose(self, node: NodeId) -> SE3 | None:
        """``world_from_node``; None where it is not known."""
        return self._poses.get(node)

    def near(self, world_from_live: SE3, radius_m: float) -> set[NodeId]:
        """The nodes that are truly within a radius and look in the same direction (method §3.1)."""
        apart_m = np.linalg.norm(self._positions - world_from_live.translation, axis=1)
        alike = self._headings @ world_from_live.rotation[:, 2] >= np.cos(_VIEW_GATE_RAD)
        return {self._ids[k] for k in np.flatnonzero((apart_m <= radius_m) & alike)}

    def start(self, world_from_live: SE3) -> Position | None:
        """The position seen from the nearest node with the same heading; None without nodes.

        Rather of those that hang together: what a drive saved where its odometry had lost track,
        in heavy rain, may be joined to nothing, and a robot set down there would find no other
        node all day.
        """
        if not self._ids:
            return None
        distance_m = np.linalg.norm(self._positions - world_from_live.translation, axis=1)
        away = self._headings @ world_from_live.rotation[:, 2] < np.cos(_VIEW_GATE_RAD)
        apart = ~self._in_main | (distance_m > DEFAULT_RADIUS_M)
        # Nodes that look another way only where there are no others.
        node = self._ids[int(np.lexsort((distance_m, apart, away))[0])]
        return self._from(node, world_from_live)

    def seen_from(self, world_from_live: SE3, radius_m: float) -> list[Position]:
        """The position seen from each node of `near`, the nearest first; ties by id."""
        found = [self._from(node, world_from_live) for node in self.near(world_from_live, radius_m)]
        return sorted(found, key=lambda one: (one.node_from_live.distance_m, one.node))

    def _from(self, node: NodeId, world_from_live: SE3) -> Position:
        covariance = np.diag([_SIGMA_M**2] * 3 + [_SIGMA_RAD**2] * 3)
        return Position(node, self._poses[node].inverse() @ world_from_live, covariance)


def _in_largest_component(graph: ExperienceGraph, nodes: Sequence[NodeId]) -> NDArray[np.bool_]:
    """(N,) whether each node is in the graph's largest connected component."""
    labels = graph.components()
    largest = np.argmax(np.bincount(labels)) if len(labels) else -1
    rows = np.array([graph.index(node) for node in nodes], np.int64)
    return np.asarray(labels[rows] == largest)


def start_by_matching(
    opened: Map,
    frames: Sequence[LoggedFrame],
    live: SessionId,
    matcher: Matcher,
    acceptance: AcceptanceConfig,
) -> tuple[int, Position] | None:
    """The first frame that matches a node of the map, and its position there.

    Every node is matched, so that where a drive starts does not depend on any policy. It is held
    to what a lost robot must show. Where the first 200 frames match nothing, nothing will.

    Returns:
        Number of the frame and the position; None where there is none.
    """
    for number, logged in enumerate(frames[:200]):
        frame = logged.frame
        if frame.status is not FrameStatus.OK:
            continue
        live_id = node_id(live, frame.stamp_ns)
        found = []
        for node in opened.graph.nodes:
            match = matcher.match(frame, live_id, node.id, None)
            spread = partial(matcher.spread, frame, live_id, node.id, match)
            if accept_lost(match, spread, acceptance):
                found.append((match, node.id))
        if found:
            match, best = max(found, key=lambda one: (one[0].inliers, one[1].int))
            assert match.reference_from_live is not None
            assert match.covariance is not None
            return number, Position(best, match.reference_from_live, match.covariance)
    return None


class KeptMaps:
    """The map files requested last, as they were when they were opened; one worker's."""

    def __init__(self, files: int, cache_bytes: int = DEFAULT_CACHE_BYTES) -> None:
        self._most = files
        self._cache_bytes = cache_bytes
        self._files: OrderedDict[tuple[Path, int], dict[int | None, Map]] = OrderedDict()

    def open(self, path: Path, at: int | None = None) -> Map:
        """A map, of a revision if one is given. It is closed here, once others are requested."""
        # A map that was made again is another file of the same name.
        file = path, path.stat().st_ino
        maps = self._files.setdefault(file, {})
        self._files.move_to_end(file)
        while len(self._files) > self._most:
            _close(self._files.popitem(last=False)[1])
        if at not in maps:
            maps[at] = Map.open(path, at=at, cache_bytes=self._cache_bytes)
        return maps[at]

    def close(self) -> None:
        """Closes them all."""
        for maps in self._files.values():
            _close(maps)
        self._files.clear()


def _close(maps: dict[int | None, Map]) -> None:
    for opened in maps.values():
        opened.close()
