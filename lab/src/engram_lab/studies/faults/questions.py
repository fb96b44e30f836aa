"""Questions of one kind: robots drive in maps of towns, something happens, fixes are counted.

`engram lab evaluate faults --only NAME` asks one. Each is a function of `QUESTIONS`: what it does
stands in its docstring. All count alike (`engram_lab.accuracy.Count`).
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from engram.config import config_hash
from engram.doctor.table import Severity
from engram.errors import ConfigError
from engram.fleet.dream import DreamOptions, dream, localised_in
from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.merging import merge
from engram.frontend.frame import FrameStatus, StereoPair
from engram.frontend.frontend import Frontend
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.basin import DEFAULT_RADIUS_M
from engram.graph.model import EdgeKind, Goal, NodeId, SessionId, node_id
from engram.graph.neighbourhood import Search
from engram.graph.placing import fit_level
from engram.localiser.acceptance import AcceptanceConfig, Rule
from engram.localiser.attempts import Lanes
from engram.localiser.localisation import Budget, Localisation, Position
from engram.localiser.settings import METHOD_VERSION
from engram.mapper.mapper import MapperConfig
from engram.maps.map import Map, open_map
from engram.maps.map_files import copy_map
from engram.maps.map_frame import FramePose
from engram.measures import Drive, route_not_localised
from engram.monitor import QUIET
from engram.odometry.motion import GapFiller
from engram.odometry.odometry import Odometry
from engram.odometry.outside import OutsideMotion
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.front import Front
from engram.robot.localisers import session_of_drive
from engram.robot.mapping import extract_log, map_drive
from engram.robot.settings import RobotOptions, Settings, load_settings
from engram.robot.starting import measure, robot_on
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.opening import open_drive
from engram.sequences.sequence import LoggedFrame
from engram_lab.accuracy import FALSE_M, LEVELS, Count, Fix, is_false, squared, way_m
from engram_lab.intervals import Array, Resamples
from engram_lab.programs import Figure
from engram_lab.studies.building import edge_errors
from engram_lab.studies.drives import EvaluatedDrive, TrueNodes, Truth, split
from engram_lab.studies.faults.clips import Clip, ClipDrive, ClipPlan, Plan
from engram_lab.studies.faults.injected import (
    Shown,
    brightened,
    fixed_pattern,
    frozen,
    halved,
    never_moved,
    on_both,
    undisturbed,
)
from engram_lab.studies.faults.staging import Place, Scene, mapped_by
from engram_lab.studies.faults.study import RealPlan, localised, real_drives
from engram_lab.studies.streets import (
    HELD_OUT_TOWNS,
    Kind,
    Street,
    Try,
    WrongPlaces,
    all_streets,
    campaign_of,
    drives_in,
    light_of,
    street,
    streets,
    town_pairs,
    trial_town,
)
from engram_lab.town.campaigns import AGAIN, BESIDE, MAPPED, Campaign, estate
from engram_lab.town.session import SimulatedSequence
from engram_lab.town.simulating import campaign_folder, campaigns_folder
from engram_lab.town.streets import Fronts
from engram_lab.wheels import BIAS_RAD_S, Wheels, measured

_LEVEL = 0.95


@dataclass(frozen=True, slots=True)
class Asked:
    """What a question is asked of; empty or None: its own choice.

    Attributes:
        settings: of robots; maps are built with the default `localiser` and `gaps`.
    """

    settings: Settings
    folder: Path
    towns: tuple[int, ...] = HELD_OUT_TOWNS
    campaign: str = ""
    mapped: tuple[int, ...] = ()
    live: tuple[int, ...] = ()
    trials: int | None = None


class Table:
    """Counts of robots by row, a line of JSON for each; what the file holds is not made again."""

    def __init__(self, name: str, asked: Asked) -> None:
        asked.folder.mkdir(parents=True, exist_ok=True)
        made_by = config_hash(asked.settings)[:8]
        self._path = asked.folder / f"{name}-{METHOD_VERSION}-{made_by}.jsonl"
        lines = self._path.read_text(encoding="utf-8").splitlines() if self._path.exists() else []
        kept = [json.loads(line) for line in lines if line.endswith("}")]
        self._kept = {
            one["key"]: Count(**{**one["count"], "again": tuple(one["count"]["again"])})
            for one in kept
        }
        self._rows: dict[str, Count] = {}

    def add(self, row: str, key: str, make: Callable[[], Count]) -> Count:
        """Adds robots to a row; `key` is unique in the row."""
        key = f"{row}: {key}"
        if key not in self._kept:
            self._kept[key] = make()
            line = json.dumps({"key": key, "count": asdict(self._kept[key])})
            with self._path.open("a", encoding="utf-8") as out:
                out.write(f"{line}\n")
        self._rows[row] = self._rows.get(row, Count()) + self._kept[key]
        return self._kept[key]

    def figures(self) -> Iterator[Figure]:
        """Every row, then all together."""
        for name, one in (*self._rows.items(), ("all", sum(self._rows.values(), Count()))):
            yield from figures_of(name, one)


def figures_of(name: str, one: Count) -> Iterator[Figure]:
    """A count; the bound on false events is Poisson's."""
    yield Figure(f"{name}: robots", one.robots)
    yield Figure("  driven", one.metres / 1000, "km")
    yield Figure("  right fixes", 100 * one.right / max(one.frames, 1), "% of frames")
    yield Figure("  more than 0.5 m off", one.off, "fixes")
    yield Figure("  false", one.false, "fixes")
    yield Figure("  false with confidence above 7", one.sure, "fixes")
    yield Figure("  robots with false fixes", one.hurt)
    yield Figure("  false events", one.events)
    if one.metres:
        bound = float(chi2.ppf(_LEVEL, 2 * (one.events + 1)) / 2)
        yield Figure("  their upper bound, 95 %", 1e5 * bound / one.metres, "per 100 km")
    yield Figure("  largest error of a fix", one.worst_m, "m")
    yield Figure("  found again", 100 * len(one.again) / max(one.robots, 1), "% of robots")
    if one.again:
        yield Figure("  after (median)", float(np.median(one.again)), "frames")
        yield Figure("  after (worst)", max(one.again), "frames")


def paired(name: str, before: Sequence[float], after: Sequence[float]) -> Iterator[Figure]:
    """Shares of routes that the same drives miss by two ways, and the difference with its 90 %."""
    a, b = np.array(before), np.array(after)

    def more(weights: Array) -> Array:
        return np.asarray(weights @ (b - a) / len(a))

    found = Resamples.of(len(a)).interval(more)
    yield Figure(f"{name}: missed", 100 * float(a.mean()), "%")
    yield Figure("  instead", 100 * float(b.mean()), "%")
    for what, value in (("more", found.estimate), ("from", found.low), ("to", found.high)):
        yield Figure(f"  {what}", 100 * value, "points")


_STANDS, _VIEW_GATE_RAD, _CERTAIN = 150, float(np.deg2rad(60.0)), np.eye(6) * 0.1**2


def _campaign(asked: Asked) -> Campaign:
    """The requested campaign, or the longer trial town of the first seed."""
    return campaign_of(asked.campaign or str(asked.towns[0]))


def edges(asked: Asked) -> Iterator[Figure]:
    """A map of a campaign's drives, or of `--mapped`, one after another: wrong edges by kind.

    An edge joins two places that is more than 5 m and three of its own standard deviations off.
    Then robots that stand at 150 nodes and accept where they are: their candidates, those of them
    elsewhere, and the share of the nodes truly near that is among them.
    """
    town = _campaign(asked)
    drives = drives_in(town, asked.settings, asked.mapped or None)
    with TemporaryDirectory(prefix="engram-edges-") as folder:
        path = Path(folder) / "map.engram"
        for drive in drives.values():
            map_drive(path, open_drive(drive.path), asked.settings)
        with Map.open(path) as opened:
            true = TrueNodes(opened, {one.session.id: one.truth() for one in drives.values()})
            yield from edge_figures("edges", opened, true.pose)
            yield from _candidates(opened, true)


def edge_figures(
    name: str, opened: Map, world_from_node: Callable[[NodeId], SE3 | None]
) -> Iterator[Figure]:
    """Edges of a map by kind, how many are wrong, and how many join two places."""
    found = list(edge_errors(opened.graph.edges, world_from_node))
    for kind in EdgeKind:
        own = [one for one in found if one.kind is kind]
        if own:
            yield Figure(f"{name}, {kind}", len(own))
            yield Figure("  more than 1 m wrong", sum(one.error_m > FALSE_M for one in own))
            yield Figure("  join two places", sum(one.joins_places for one in own))
            yield Figure("  worst", max(one.error_m for one in own), "m")


def _candidates(opened: Map, true: TrueNodes) -> Iterator[Figure]:
    graph = opened.graph
    stands = np.random.default_rng(0).permutation(len(graph))[:_STANDS]
    candidates = elsewhere = near = seen = 0
    for node in stands.tolist():
        pose = true.pose(graph.node(node).id)
        if pose is None:
            continue
        search = Search(DEFAULT_RADIUS_M, _VIEW_GATE_RAD)
        found = graph.neighbourhood(node, SE3.identity(), _CERTAIN, search)
        ids = {graph.node(row).id for row in found.nodes.tolist()}
        truly = true.near(pose, DEFAULT_RADIUS_M)
        candidates, elsewhere = candidates + len(ids), elsewhere + len(ids - truly)
        near, seen = near + len(truly), seen + len(ids & truly)
    yield Figure("candidates of a robot at a node", candidates / max(len(stands), 1))
    yield Figure("  of them elsewhere", elsewhere / max(len(stands), 1))
    yield Figure("  share of what is near", 100 * seen / max(near, 1), "%")


_ROBOT, _FLEET = "one robot", "a fleet"
_SURE = {_ROBOT: MapperConfig().sure_inliers, _FLEET: MergeOptions().sure_inliers}


def saving(asked: Asked) -> Iterator[Figure]:
    """What saving weak matches brings: each drive of a town in the map of those before it.

    Once as published, once with the defaults of `mapper.sure_inliers` and `merge.sure_inliers`:
    mapped by one robot, and by a fleet, in which each robot maps one drive by itself.
    """
    nodes: dict[str, list[int]] = {}
    table = Table("saving", asked)
    for seed, by, published in product(asked.towns, _SURE, (True, False)):
        town, drives = trial_town(seed), drives_in(trial_town(seed), asked.settings)
        rule = f"{by}, {'as published' if published else 'default'}"
        with TemporaryDirectory(prefix="engram-saving-") as folder:
            path = Path(folder) / "map.engram"
            for number, drive in drives.items():
                found = _saved(path, drive, asked.settings, by, 0 if published else _SURE[by])
                if number:
                    count = partial(_judged, path, drive, found, tuple(drives.values()))
                    row = f"{rule}, {light_of(town.session(number))}"
                    table.add(row, f"{seed} {number}", count)
            with Map.open(path) as made:
                nodes.setdefault(rule, []).append(made.info().nodes)
    yield from table.figures()
    for rule, counts in nodes.items():
        yield Figure(f"{rule}: nodes of a town", float(np.mean(counts)))


def _saved(
    path: Path, drive: EvaluatedDrive, settings: Settings, by: str, sure_inliers: int
) -> list[Localisation]:
    """Localises a drive in a map, and adds it: mapped, or by merging its robot's own map."""
    sequence = open_drive(drive.path)
    if by == _ROBOT:
        mapper = replace(settings.mapper, sure_inliers=sure_inliers)
        return map_drive(path, sequence, replace(settings, mapper=mapper)).results
    found: list[Localisation] = []
    if path.exists():
        with Map.open(path) as fleet, robot_on(fleet, sequence, settings) as robot:
            found = list(robot.drive(sequence))
    own = path.with_name(f"{drive.name}.engram")
    map_drive(own, open_drive(drive.path), settings)
    merge(path, [own], replace(MergeOptions(), sure_inliers=sure_inliers), settings=settings)
    return found


def _judged(
    path: Path,
    drive: EvaluatedDrive,
    found: Sequence[Localisation],
    mapped: Sequence[EvaluatedDrive],
) -> Count:
    truth, fixes, poses = drive.truth(), [], []
    assert truth is not None
    with Map.open(path) as made:
        nodes = TrueNodes(made, {one.session.id: one.truth() for one in mapped})
        for at, one in enumerate(found):
            world_from_live = truth.at(one.stamp_ns)
            assert world_from_live is not None
            poses.append(world_from_live)
            pose = None if one.node is None else nodes.pose(one.node)
            if pose is not None and one.node_from_live is not None:
                off = world_from_live.inverse() @ pose @ one.node_from_live
                wrong = is_false(off.distance_m, off.angle_rad)
                fixes.append(Fix(at, off.distance_m, wrong, one.confidence))
    return Count.of(fixes, poses)


def _missed(centre: Path, log: Path, settings: Settings, options: RobotOptions) -> float:
    """Share of a drive's route without a match, of a robot that starts lost."""
    with Map.open(centre) as opened:
        return route_not_localised([measure(opened, open_drive(log), settings, options)])


_MAPPED, _REMEMBERED, _JUDGED = (0, 3, 5), (1, 2, 4, 6), (7, 8, 10, 11)
# Policy, lanes, and whether the settings are the paper's.
_TRIED = (
    ("path", 1, False), ("path", 1, True), ("path", 2, False), ("path", 2, True),
    ("path-near", 2, False), ("recall", 1, False), ("recall", 2, False),
)  # fmt: skip


def memories(asked: Asked) -> Iterator[Figure]:
    """Robots that only localise: whether their memory, merged, helps on later drives.

    Three drives are mapped (`--mapped`); four more robots localise in a copy of that map and hand
    in what they remember. `--live` drives are localised with and without these memories.
    """
    mapped, live = asked.mapped or _MAPPED, asked.live or _JUDGED
    drives = drives_in(_campaign(asked), asked.settings, [*mapped, *_REMEMBERED, *live])
    with TemporaryDirectory(prefix="engram-memories-") as name:
        folder = Path(name)
        without, with_them = folder / "without.engram", folder / "with.engram"
        for number in mapped:
            map_drive(without, open_drive(drives[number].path), asked.settings)
        copy_map(without, with_them)
        robots = []
        for number in _REMEMBERED:
            robots.append(folder / f"{number}.engram")
            copy_map(without, robots[-1])
            sequence = open_drive(drives[number].path)
            with Map.open(robots[-1]) as opened, robot_on(
                opened, sequence, asked.settings, remembers=True
            ) as robot:  # fmt: skip
                list(robot.drive(sequence))
        merge(with_them, robots)
        for policy, lanes, is_paper in _TRIED:
            settings = load_settings(Path("linegar2015")) if is_paper else asked.settings
            options = RobotOptions(ranking=policy, lanes=lanes, rounds=1)
            before, after = (
                [_missed(where, drives[number].path, settings, options) for number in live]
                for where in (without, with_them)
            )
            paper = ", the paper's settings" if is_paper else ""
            yield from paired(f"{policy}, {lanes} lanes{paper}, without memories", before, after)


def directions(asked: Asked) -> Iterator[Figure]:
    """Both directions of a road: routes missed in a map of one drive in each.

    `--mapped` are the two drives: the town's first, and its first against it. All other drives, or
    `--live`, are localised there, and in a map of the first alone.
    """
    town = _campaign(asked)
    against = [one.number for one in town.sessions if one.reverse]
    if not against:
        raise ConfigError(f"campaign {town.name}: no drive goes against the others")
    pair = asked.mapped or (0, against[0])
    live = asked.live or tuple(n for n in range(len(town.sessions)) if n not in pair)
    drives = drives_in(town, asked.settings, [*pair, *live])
    shares: dict[bool, list[tuple[float, float]]] = {}
    with TemporaryDirectory(prefix="engram-directions-") as folder:
        one, both = Path(folder) / "one.engram", Path(folder) / "both.engram"
        map_drive(one, open_drive(drives[pair[0]].path), asked.settings)
        copy_map(one, both)
        map_drive(both, open_drive(drives[pair[1]].path), asked.settings)
        for number in live:
            alone, missed = (
                _missed(where, drives[number].path, asked.settings, RobotOptions())
                for where in (one, both)
            )
            shares.setdefault(town.session(number).reverse, []).append((alone, missed))
    for reverse, found in shares.items():
        name = "against the usual direction" if reverse else "the usual direction"
        yield from paired(f"{name}, one direction mapped", *zip(*found, strict=True))


# The other camera in the frame of the usual one: x to the right, y down, z ahead.
MOUNTED = SE3.exp([0.3, -0.5, 0, 0, 0, 0]) @ SE3.exp([0, 0, 0, -np.deg2rad(10.0), 0, 0])


class MountedSequence(SimulatedSequence):
    """A session of a campaign, seen through a camera that is mounted elsewhere on the robot."""

    def __init__(self, campaign: Campaign, session: int, rig_from_cam: SE3) -> None:
        super().__init__(campaign, session)
        cam_from_rig = rig_from_cam.inverse()
        self._camera = replace(self.drive.camera, cam_from_rig=cam_from_rig)
        self.drive.poses = [
            replace(
                pose,
                world_from_cam=pose.world_from_cam @ rig_from_cam,
                twist=cam_from_rig.adjoint() @ pose.twist,
            )
            for pose in self.drive.poses
        ]

    @property
    def camera(self) -> StereoCamera:
        """The robot's camera, with its mounting."""
        return self._camera

    def __iter__(self) -> Iterator[StereoPair]:
        return (replace(pair, camera=self._camera) for pair in self.drive)


def mountings(asked: Asked) -> Iterator[Figure]:
    """Cameras 0.5 m higher, 0.3 m aside and pitched down by 10°, in a map by the usual camera.

    Drive 0 is mapped; 6, 7, 8 and 10, or `--live`, are localised as they are and rendered again.
    """
    town, live = _campaign(asked), asked.live or (6, 7, 8, 10)
    drives = drives_in(town, asked.settings, [0, *live])
    other = campaign_folder(campaigns_folder(), town) / "mounted"
    other.mkdir(exist_ok=True)
    usual, mounted = list[float](), list[float]()
    with TemporaryDirectory(prefix="engram-mountings-") as folder:
        centre = Path(folder) / "map.engram"
        map_drive(centre, open_drive(drives[0].path), asked.settings)
        for number in live:
            log = other / drives[number].path.name
            if not log.exists():
                extract_log(MountedSequence(town, number, MOUNTED), log, asked.settings)
            for shares, path in ((usual, drives[number].path), (mounted, log)):
                shares.append(_missed(centre, path, asked.settings, RobotOptions()))
    return paired("camera as mapped, then mounted otherwise", usual, mounted)


def lenses(asked: Asked) -> Iterator[Figure]:
    """A robot in a map by another lens, which is ignored or accounted for, in each town.

    Drive 0 is mapped. The town's first drive by another lens is localised, with one attempt a
    frame and with four, and its first by the same lens: what that misses is not the lens's fault.
    """
    ignored = replace(asked.settings, localiser=replace(asked.settings.localiser, lens_depth_m=0.0))
    budgets = {"one attempt": RobotOptions(lanes=1, rounds=1), "four": RobotOptions(lanes=2)}
    shares: dict[str, list[tuple[float, float, float]]] = {name: [] for name in budgets}
    for seed in asked.towns:
        drives = list(drives_in(trial_town(seed), asked.settings).values())
        lens_px = drives[0].camera.fx
        own = next(one for one in drives[1:] if one.camera.fx == lens_px).path
        other = next(one for one in drives[1:] if one.camera.fx != lens_px).path
        with TemporaryDirectory(prefix="engram-lenses-") as folder:
            centre = Path(folder) / "map.engram"
            map_drive(centre, open_drive(drives[0].path), asked.settings)
            for name, options in budgets.items():
                tried = ((other, ignored), (other, asked.settings), (own, asked.settings))
                missed = [_missed(centre, log, settings, options) for log, settings in tried]
                shares[name].append((missed[0], missed[1], missed[2]))
    for name, found in shares.items():
        before, after, by_own = zip(*found, strict=True)
        yield from paired(f"{name}, lens ignored, then accounted for", before, after)
        yield Figure("  by the map's own lens", 100 * float(np.mean(by_own)), "%")


_HANDED_IN, _VALIDATION, _HELD_OUT = (0, 1, 2, 4, 5, 6), (7, 9, 11), (3, 8, 10)


def dreams(asked: Asked) -> Iterator[Figure]:
    """Dreaming for `--trials` minutes (30): what it adds, and whether drives never seen do worse.

    Six robots map one drive each and hand in. The fleet map dreams over three validation drives;
    three more, which nothing else sees, are localised in it before and after.
    """
    drives = drives_in(_campaign(asked), asked.settings, [*_HANDED_IN, *_VALIDATION, *_HELD_OUT])
    logs = {number: one.path for number, one in drives.items()}
    with TemporaryDirectory(prefix="engram-dreams-") as folder:
        robots = [Path(folder) / f"{number}.engram" for number in _HANDED_IN]
        for number, robot in zip(_HANDED_IN, robots, strict=True):
            map_drive(robot, open_drive(logs[number]), asked.settings)
        before, centre = Path(folder) / "before.engram", Path(folder) / "fleet.engram"
        copy_map(robots[0], before)
        merge(before, robots[1:])
        copy_map(before, centre)
        options = DreamOptions(minutes=float(asked.trials or 30), workers=2)
        dream(centre, robots, [logs[one] for one in _VALIDATION], asked.settings, options)
        for name, numbers in (("validation", _VALIDATION), ("held-out", _HELD_OUT)):
            those = [logs[one] for one in numbers]
            found: Sequence[Sequence[Drive]] = localised_in(
                [before, centre], those, asked.settings, RobotOptions(), 2, QUIET
            )
            shares = [[route_not_localised([one]) for one in part] for part in found]
            yield from paired(f"{name} drives, before the dream", *shares)
        for name, path in (("before", before), ("after", centre)):
            with Map.open(path) as opened:
                yield Figure(f"nodes {name}", len(opened.graph))


# Goals are planted after this many merges, this far from the route at most, metres.
_AFTER, _ASIDE_M, _GOALS = 2, 2.0, 40


def goals(asked: Asked) -> Iterator[Figure]:
    """How far goals and the map frame move while drives are merged one by one.

    Each drive is mapped by a robot of its own and merged. With more `--trials` than the campaign
    has drives, these come again: round r takes every r-th frame. After two merges 40 goals are
    planted at places next to the route.
    """
    town = _campaign(asked)
    drives = list(drives_in(town, asked.settings).values())
    truths: dict[SessionId, Truth | None] = {}
    listed: dict[str, float] = {}
    planted: dict[str, tuple[float, float]] = {}
    true: dict[str, SE3] = {}
    with TemporaryDirectory(prefix="engram-goals-") as folder:
        fleet = Path(folder) / "fleet.engram"
        for number in range(asked.trials or len(drives)):
            again, at = divmod(number, len(drives))
            log = open_drive(drives[at].path, frames=f"{again}::{again + 1}")
            assert isinstance(log, FrameLog)
            truths[session_of_drive(log).id] = drives[at].truth()
            own = Path(folder) / f"{number}.engram"
            map_drive(own, log, asked.settings)
            (done,) = merge(fleet, [own])
            for name, by_m in done.moved.goals.items() if done.moved else ():
                listed[name] = listed.get(name, 0.0) + by_m
            own.unlink()
            if number + 1 == _AFTER:
                _plant(fleet)
                planted, true = _located(fleet), _truly_at(fleet, truths)
        now, truly, errors_m = (
            _located(fleet),
            _truly_at(fleet, truths),
            _frame_errors(fleet, truths),
        )
    moved_m = {name: float(np.hypot(*np.subtract(now[name], was))) for name, was in planted.items()}
    unlisted_m = [max(0.0, far - listed.get(name, 0.0)) for name, far in moved_m.items()]
    drift_m = [
        (true[name].inverse() @ truly[name]).distance_m for name in true.keys() & truly.keys()
    ]
    yield Figure("drives merged", len(truths))
    yield Figure("goals moved in the frame, median", float(np.median([*moved_m.values()])), "m")
    yield Figure("  largest", max(moved_m.values()), "m")
    yield Figure("  largest that no report lists", max(unlisted_m), "m")
    yield Figure("  largest in truth", max(drift_m, default=0.0), "m")
    yield Figure("error of the frame, median", float(np.median(errors_m)), "m")
    yield Figure("  90 %", float(np.percentile(errors_m, 90)), "m")


def _plant(path: Path) -> None:
    """Stores goals near nodes drawn at random."""
    rng = np.random.default_rng(0)
    with Map.open(path, writes=True) as store:
        frame, graph, made = store.frame, store.graph, list[Goal]()
        for number in range(_GOALS):
            at = FramePose.of(frame.pose(graph.node(int(rng.integers(len(graph)))).id))
            x_m, y_m = np.array([at.x_m, at.y_m]) + rng.uniform(-_ASIDE_M, _ASIDE_M, 2)
            yaw_rad = at.yaw_rad + rng.uniform(-0.5, 0.5)
            made.append(frame.goal(float(x_m), float(y_m), yaw_rad, f"goal {number}"))
        with store.begin_revision(author="lab", message="goals", configuration={}) as writer:
            for goal in made:
                writer.add_mark(goal)
            writer.commit()


def _located(path: Path) -> dict[str, tuple[float, float]]:
    """Where each goal lies in the map frame, metres."""
    with Map.open(path) as store:
        poses = {name: store.frame.locate(goal) for name, goal in store.goals.items()}
    return {name: (pose.x_m, pose.y_m) for name, pose in poses.items()}


def _truly_at(path: Path, truths: dict[SessionId, Truth | None]) -> dict[str, SE3]:
    """The true pose that each goal names, by the truth of its node."""
    with Map.open(path) as store:
        true = TrueNodes(store, truths)
        poses = {name: (true.pose(goal.node), goal) for name, goal in store.goals.items()}
    return {
        name: pose @ goal.node_from_goal for name, (pose, goal) in poses.items() if pose is not None
    }


def _frame_errors(path: Path, truths: dict[SessionId, Truth | None]) -> np.ndarray:
    """(N,) float64, metres: error of each node of the largest component after the best fit."""
    with Map.open(path) as store:
        true, labels = TrueNodes(store, truths), store.graph.components()
        inside = np.flatnonzero(labels == np.argmax(np.bincount(labels)))
        poses = {int(at): true.pose(store.graph.node(int(at)).id) for at in inside}
        known = [at for at, pose in poses.items() if pose is not None]
        places = np.array([pose.translation for pose in poses.values() if pose is not None])
        laid = store.layout().positions[known]
    return np.asarray(np.linalg.norm((fit_level(laid, places) @ laid - places)[:, :2], axis=1))


_SHARES, _CONTRASTS = (0.1, 0.2, 0.35, 0.6), (0.25, 0.5, 1.0)
_SIDES = ("bottom", "top", "left", "right")
_DEPTH_M = 2.4


def standing(asked: Asked) -> Iterator[Figure]:
    """Fixed patterns and frozen streams: maps that are too short without a warning, false fixes.

    Every other frame of a clip is mapped and the others localised, both with the same thing fixed
    to the camera, from one of four sides, of growing size and contrast. Then the picture is frozen
    from the start, or at rest while wheels turn. Last, what is learnt where nothing is fixed.
    Clips: a rendered street; KITTI 06 and KITTI raw 0001 where ENGRAM_DATA names them.
    """
    del asked
    for name, clip in standing_clips():
        for contrast in _CONTRASTS:
            silent, count = 0, Count()
            for share, side in product(_SHARES, _SIDES):
                rng = np.random.default_rng(_SIDES.index(side))
                shown = fixed_pattern(clip.pairs, share, 0, rng, side, _DEPTH_M, contrast)
                short, one = mapped_and_driven(clip, shown)
                silent, count = silent + short, count + one
            row = f"{name}, pattern of contrast {contrast}"
            yield Figure(f"{row}: short maps without a warning", silent, f"of {count.robots}")
            yield from figures_of(row, count)
        for what, shown, wheels in frozen_clips(clip):
            _, one = mapped_and_driven(clip, shown, wheels, clean=True)
            yield from figures_of(f"{name}, {what}", one)
        for what, pairs in (("undisturbed", clip.pairs), ("parked", parked(clip))):
            front = Front(Settings())
            for pair in pairs:
                front.take(pair)
            yield Figure(f"{name}, {what}: learnt", front.fixed_share, "of the image")
            yield Figure(f"{name}, {what}: in doubt", front.doubts, "frames")


def standing_clips() -> Iterator[tuple[str, Clip]]:
    """The clips, at half size, by name; the truth of KITTI raw is odometry's."""
    street = ClipPlan("wildcat", 21, 1, count=40).read()
    yield "town", replace(street, pairs=[halved(one, 1.5) for one in street.pairs])
    named = os.environ.get("ENGRAM_DATA")
    if not named:
        return
    whole = RealPlan("kitti-06", "whole", Path(named)).read()
    pairs = [replace(halved(one, 2.0), stamp_ns=k * 10**8) for k, one in enumerate(whole.pairs)]
    yield "kitti-06", replace(whole, pairs=pairs)
    drive = open_drive(Path(named) / "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync")
    raw = [halved(one, 2.0) for one in drive if isinstance(one, StereoPair)]
    yield "raw-0001", Clip(whole.plan, raw, _by_odometry(raw))


def _by_odometry(pairs: Sequence[StereoPair]) -> list[SE3]:
    frontend, odometry, poses = Frontend(), Odometry(), [SE3.identity()]
    for pair in pairs:
        step = odometry.step(frontend.extract(pair)).prev_from_curr
        poses.append(poses[-1] if step is None else poses[-1] @ step)
    return poses[1:]


def _noisy(pair: StereoPair, seed: int) -> StereoPair:
    rng = np.random.default_rng(seed)
    return on_both(
        pair, lambda one: np.clip(one + rng.normal(0, 1.0, one.shape), 0, 255).astype(np.uint8)
    )


def parked(clip: Clip) -> list[StereoPair]:
    """A robot that stands at the first frame, before a camera with a little noise."""
    first = clip.pairs[0]
    return [replace(_noisy(first, k), stamp_ns=k * 10**8) for k in range(5 * len(clip))]


Measured = Sequence[OutsideMotion]


def frozen_clips(clip: Clip) -> Iterator[tuple[str, list[Shown], Measured | None]]:
    """Streams that freeze, with and without what wheels measure at each frame."""
    poses = clip.world_from_cam
    wheels = [OutsideMotion(a.inverse() @ b, 0.1) for a, b in pairwise([poses[0], *poses])]
    for burnt_in, outside in product((False, True), (None, wheels)):
        rng = np.random.default_rng(0)
        shown = never_moved(clip.pairs, len(clip), 0, rng, burnt_in=burnt_in)
        stamp, by = " with a burnt-in time" if burnt_in else "", ", wheels" if outside else ""
        yield f"frozen from the start{stamp}{by}", shown, outside
    for noise in (False, True):
        rest = [_noisy(clip.pairs[0], k) for k in range(5)]
        after = [_noisy(rest[-1], 10 + k) if noise else rest[-1] for k in range(len(clip) - 5)]
        shown = [
            Shown(max(0, k - 4), replace(one, stamp_ns=k * 10**8))
            for k, one in enumerate([*rest, *after])
        ]
        still = [OutsideMotion(SE3.identity(), 0.1)] * 5
        name = f"frozen at rest, wheels turn{', noise added' if noise else ''}"
        yield name, shown, [*still, *wheels[1:]]


def mapped_and_driven(
    clip: Clip, shown: Sequence[Shown], outside: Measured | None = None, *, clean: bool = False
) -> tuple[bool, Count]:
    """Maps every other frame, and localises the others in the map.

    Args:
        outside: what wheels measure at each frame that is localised; None without wheels.

    Returns:
        Whether more than a tenth of the route is missing without a warning; the fixes.
    """
    source = (undisturbed(clip.pairs) if clean else shown)[::2]
    live = list(shown) if clean else list(shown[1::2])
    with TemporaryDirectory(prefix="engram-standing-") as folder:
        path, fixes = Path(folder) / "map.engram", list[Fix]()
        drive = ClipDrive(clip.plan, [one.pair for one in source])
        made = map_drive(path, drive, Settings(), RobotOptions(force=True))
        assert made.diagnosis is not None
        warned = any(one.severity is not Severity.NOTE for one in made.diagnosis.findings)
        true = {one.pair.stamp_ns: clip.world_from_cam[one.frame] for one in source}
        with open_map(path) as opened:
            nodes = {node.id: true[node.stamp_ns] for node in opened.graph.nodes}
            place = Place(path, opened, nodes)
            laid_m = sum(edge.a_from_b.distance_m for edge in opened.graph.edges)
            with opened.robot(clip.pairs[0].camera) as robot:
                for at, one in enumerate(live):
                    pair = replace(one.pair, stamp_ns=one.pair.stamp_ns + 10**12)
                    found = robot.step(pair, motion=outside[at] if outside and at else None)
                    fix = place.fix(at, found, clip.world_from_cam[one.frame])
                    fixes += [] if fix is None else [fix]
    short = laid_m < 0.9 * way_m(clip.world_from_cam[::2])
    return short and not warned, Count.of(fixes, [clip.world_from_cam[one.frame] for one in live])


_LOST_ROUNDS = Budget().lost_rounds
# A pose that is known well, and motion of a robot at rest.
_STILL = OdometryStep(OdometryStatus.OK, SE3.identity(), 1e-6 * np.eye(6), 200)


def misplaced(asked: Asked, *kinds: Kind) -> Iterator[Figure]:
    """Robots on the streets of some towns, as many of each kind; the 40 frames after it count."""
    table, found = (
        Table("misplaced", asked),
        list(streets(asked.towns, asked.settings, _LOST_ROUNDS)),
    )
    each = -(-(asked.trials or 3000) // (len(found) * len(kinds)))
    for name, there in found:
        for kind in kinds:
            for one in there.tries(kind, each, seed=1):
                table.add(kind.value, f"{name}, {one}", partial(there.count, one))
        there.close()
    return table.figures()


def hints(asked: Asked) -> Iterator[Figure]:
    """Robots that are given a place 15 m or more off (σ 0.1, 1 or 3 m), or carried there unseen."""
    return misplaced(asked, Kind.MISPLACED, Kind.CARRIED)


def lost(asked: Asked) -> Iterator[Figure]:
    """Robots that are lost, or drive on past a gap of 5 to 29 frames without odometry."""
    return misplaced(asked, Kind.LOST, Kind.GAP)


def roads(asked: Asked) -> Iterator[Figure]:
    """Undisturbed robots on a campaign, told their place or started lost: events per 100 km.

    Of `keble`, or CAMPAIGN, `--trials` maps (8) of three drives each are drawn, or one is built
    from `--mapped`. Every other drive, or `--live`, is driven there to its end: once from its
    first frame, once from a frame drawn at random, lost.
    """
    campaign, table = campaign_of(asked.campaign or "keble"), Table("undisturbed", asked)
    every = range(len(campaign.sessions))
    needed = {*asked.mapped, *asked.live} if asked.live else set(every)
    drives = drives_in(campaign, asked.settings, sorted(needed))
    maps = [asked.mapped] if asked.mapped else drawn_maps(len(every), asked.trials or 8)
    for mapped in maps:
        for number in (one for one in asked.live or every if one not in mapped):
            live = drives[number]
            rng = np.random.default_rng(live.session.start_ns)
            for kind in (Kind.UNDISTURBED, Kind.COLD):

                def driven() -> Count:
                    there = street(campaign, mapped, drives, live, asked.settings)  # noqa: B023
                    first = int(rng.integers(len(there.frames) // 2))  # noqa: B023
                    one = Try(kind, first if kind is Kind.COLD else 0)  # noqa: B023
                    with closing(there):
                        return there.count(one)

                table.add(kind.value, f"{campaign.home} {mapped} {live.name}", driven)
    return table.figures()


def drawn_maps(drives: int, maps: int, mapped: int = 3, seed: int = 0) -> list[tuple[int, ...]]:
    """Which drives each map is built from, in the order of time; one drawn twice counts once."""
    rng = np.random.default_rng(seed)
    drawn = (rng.choice(drives, mapped, replace=False).tolist() for _ in range(maps))
    return list(dict.fromkeys(tuple(sorted(one)) for one in drawn))


def right_fixes(asked: Asked) -> Iterator[Figure]:
    """Right fixes by `confidence` and by the published rule of inliers, by weather.

    Every drive of a small town is localised in each map that it is no part of, from a true start.
    Lost is what the rule of inliers found rightly and `confidence` did not, less the opposite.
    """
    table, lost_points = Table("right-fixes", asked), []
    for plan, name, there in all_streets(asked.towns, asked.settings):
        right = {}
        for rule in Rule:
            acceptance = replace(asked.settings.localiser.acceptance, rule=rule)
            localiser = replace(asked.settings.localiser, acceptance=acceptance)
            there.settings = replace(asked.settings, localiser=localiser)
            undisturbed_robot = partial(there.count, Try(Kind.UNDISTURBED))
            right[rule] = table.add(f"{light_of(plan)}, {rule}", name, undisturbed_robot).right
        lost_points.append(100 * (right[Rule.INLIERS] - right[Rule.CONFIDENCE]) / len(there.frames))
        there.close()
    yield from table.figures()
    yield Figure("lost by `confidence`, mean of the drives", float(np.mean(lost_points)), "points")
    yield Figure("  most of one drive", max(lost_points), "points")


def wheels(asked: Asked) -> Iterator[Figure]:
    """Drives without wheels and with them, right and wrong in six ways, by weather."""
    table = Table("wheels", asked)
    for plan, name, there in all_streets(asked.towns, asked.settings):
        stamps = [one.frame.stamp_ns for one in there.frames]
        for kind in (None, *Wheels):
            outside = None if kind is None else measured(there.truth, stamps, 1, kind)
            row = f"{light_of(plan)}, {'no wheels' if kind is None else kind.value}"
            robot = partial(there.count, Try(Kind.UNDISTURBED), outside=outside)
            table.add(row, name, robot)
        there.close()
    return table.figures()


_BLACK_M, _SETTLED_M, _APART_M, _REST = 50.0, 20.0, 15.0, 20


def blackouts(asked: Asked) -> Iterator[Figure]:
    """Robots whose cameras are black for 50 m, five seconds at 10 m/s, with and without wheels.

    Wheels measure 2 % too much and scatter by 1 %; the gyroscope has a bias of 0.01 rad/s, noise of
    0.002 rad/s, and two seconds of rest at the start. Nothing searches for a lost robot: it is
    found by dead reckoning. Frames until found count from the first bright one.
    """
    table = Table("blackouts", asked)
    for name, there in streets(asked.towns, asked.settings, _LOST_ROUNDS):
        steps = [
            (a.inverse() @ b).distance_m for a, b in zip(there.truth, there.truth[1:], strict=False)
        ]
        along_m = np.concatenate([[0.0], np.cumsum(steps)])
        starts = np.arange(_SETTLED_M, along_m[-1] - _BLACK_M - 10, _APART_M)[: asked.trials or 20]
        for start, aided in product(starts.tolist(), (True, False)):
            first = int(np.searchsorted(along_m, start))
            last = int(np.searchsorted(along_m, along_m[first] + _BLACK_M)) - 1
            row = "wheels and gyroscope" if aided else "cameras alone"
            robot = partial(_in_the_dark, there, first, last, aided)
            table.add(row, f"{name} from frame {first}", robot)
        there.close()
    return table.figures()


def _in_the_dark(there: Street, first: int, last: int, aided: bool) -> Count:
    stamps = [one.frame.stamp_ns for one in there.frames]
    outside = measured(there.truth, stamps, seed=first)
    rest, found = OutsideMotion(SE3.identity(), 0.1, True, BIAS_RAD_S), []
    with there.robot(relocalises=False) as robot:
        start = there.nodes.start(there.truth[0])
        assert start is not None
        robot.place_at(start)
        for number in range(_REST, 0, -1):  # the first frame again and again, before the start
            frame = replace(there.frames[0].frame, stamp_ns=stamps[0] - number * 10**8)
            step = there.frames[0].odometry if number == _REST else _STILL
            robot.step(LoggedFrame(frame, step), motion=rest if aided and number < _REST else None)
        for number, logged in enumerate(there.frames[: last + 62]):
            frame, step = logged.frame, logged.odometry if number else _STILL
            if first <= number <= last:
                frame = replace(frame, status=FrameStatus.DARK)
                step = OdometryStep(OdometryStatus.UNUSABLE_FRAME)
            elif number == last + 1:
                step = OdometryStep(OdometryStatus.NO_CONSENSUS)
            motion = (outside[number] or rest) if aided else None
            found.append((number, robot.step(LoggedFrame(frame, step), motion=motion)))
    return there.counted(found, after=last + 1)


def stalls(asked: Asked) -> Iterator[Figure]:
    """A camera that stalls or freezes on KITTI 06, in maps of the whole drive and of parts.

    Stalls last 0.8 to 3.2 s at 10 Hz; `--trials` above 100 tries all gaps up to 4 s.
    """
    clip, fine = kitti_clip(), (asked.trials or 0) > 100
    starts = (range(4, 44, 4), range(1, 41)) if fine else (range(4, 40, 6), range(8, 33, 3))
    gaps = [(a, a + gap) for a, gap in product(*starts) if a + gap < len(clip) - 4]
    for name, frames in (
        ("whole", slice(None)), ("every other frame", slice(0, None, 2)), ("first half", slice(25))
    ):  # fmt: skip
        with TemporaryDirectory(prefix="engram-stalls-") as folder:
            path = Path(folder) / "map.engram"
            yield from figures_of(
                f"stalls, {name}", disturbed(clip, frames, path, stalled(clip, gaps))
            )
            path = Path(folder) / "again.engram"
            frozen = frozen_streams(clip, (10, 20, 30))
            yield from figures_of(f"freezes, {name}", disturbed(clip, frames, path, frozen))


def kitti_clip() -> Clip:
    """KITTI 06 of ENGRAM_DATA with its truth."""
    data = os.environ.get("ENGRAM_DATA")
    if not data:
        raise SystemExit("set ENGRAM_DATA to the folder of the real images")
    return RealPlan("kitti-06", "whole", Path(data)).read()


Disturbed = tuple[list[Shown], int]


def stalled(clip: Clip, gaps: Sequence[tuple[int, int]]) -> Iterator[Disturbed]:
    """The drive without the frames between two: what is shown, and the first frame after it."""
    whole = undisturbed(clip.pairs)
    return (([*whole[: last + 1], *whole[again:]], again) for last, again in gaps)


def frozen_streams(clip: Clip, starts: Sequence[int], length: int = 10) -> Iterator[Disturbed]:
    """Both cameras, or one of them, repeat an image under new stamps."""
    rng = np.random.default_rng(0)
    for start, sides in product(starts, (("left", "right"), ("left",), ("right",))):
        yield frozen(clip.pairs, length, start, rng, sides), start + length


def disturbed(
    clip: Clip,
    mapped: slice,
    path: Path,
    shown: Iterable[Disturbed],
    settings: Settings | None = None,
) -> Count:
    """Robots that are shown a disturbed clip in a map of some of its frames, made at `path`."""
    part = Clip(clip.plan, clip.pairs[mapped], clip.world_from_cam[mapped])
    place, total = mapped_by(part, path), Count()
    with closing(place.opened):
        for frames, after in shown:
            scene = Scene(clip, place, 0, 0.0, frames)
            at = next(k for k, one in enumerate(frames) if one.frame >= after)
            poses = [clip.world_from_cam[one.frame] for one in frames]
            total += Count.of(localised(scene, settings)[0], poses, at)
    return total


def darker(asked: Asked) -> Iterator[Figure]:
    """The right image at 0.1 to 0.85 of its light: KITTI 06, EuRoC V1_01, a rendered street.

    Every other frame is mapped, the others are localised. `--set frontend.side_difference=0`
    searches as if both sides were alike.
    """
    data = Path(os.environ.get("ENGRAM_DATA", ""))
    plans: list[Plan] = [ClipPlan("wildcat", 21, 1, count=60)]
    plans += [RealPlan(town, "whole", data) for town in real_drives(data)]
    for plan in plans:
        clip = plan.read()
        for gain in (1.0, 0.85, 0.7, 0.5, 0.35, 0.2, 0.1):
            shown = [
                Shown(k, replace(one, right=brightened(one.right, gain)))
                for k, one in enumerate(clip.pairs)
                if k % 2
            ]
            with TemporaryDirectory(prefix="engram-darker-") as folder:
                path = Path(folder) / "map.engram"
                count = disturbed(clip, slice(0, None, 2), path, [(shown, 0)], asked.settings)
            yield Figure(f"{plan.name}, × {gain}", 100 * count.right / count.frames, "% right")
            yield Figure("  false", count.false, "fixes")


_WITHIN_M, _FINDABLE_INLIERS, _WRONG_M = 10.0, 40, 5.0
# A match is accepted this far from its node, and right up to `_WRONG_M` off.
_REACH_M = AcceptanceConfig().reach_m


def cold_starts(asked: Asked) -> Iterator[Figure]:
    """Robots switched on anywhere in a large map: how many are found within 10 m.

    Four folds of `village`, or CAMPAIGN, are mapped. On each drive of the fifth, or `--live`,
    `--trials` robots (640) are switched on, evenly spread. Where one is not found, all nodes that
    truly stand near are matched with every frame of those 10 m: could it have been found?
    """
    campaign, table = campaign_of(asked.campaign or "village"), Table("cold-starts", asked)
    drives = drives_in(campaign, asked.settings)
    fold = split(len(drives), 5)[0]
    starts = found = wrong = possible = 0
    for number in asked.live or fold.held_out:
        there = street(campaign, fold.training, drives, drives[number], asked.settings)
        for first in first_frames(there, asked.trials or 640):
            key = f"{campaign.home}@{campaign.seed} {there.live.name} {first}"
            one = table.add("switched on", key, partial(switched_on, there, first))
            starts, wrong = starts + 1, wrong + (one.worst_m > _WRONG_M)
            if one.fixes:
                found += one.worst_m <= _WRONG_M
                continue
            missed = partial(could_be_found, there, first, one.frames)
            possible += table.add("not found, but a node near matches", key, missed).robots
        there.close()
    yield from table.figures()
    yield Figure("cold starts", starts)
    yield Figure("  found within 10 m, of those that can be", 100 * found / (found + possible), "%")
    yield Figure("  wrong place accepted (> 5 m)", 100 * wrong / starts, "%")


def first_frames(there: Street, count: int) -> list[int]:
    """So many, evenly spread, each with 10 m to drive after it; all if there are fewer."""
    steps = [one.odometry.prev_from_curr for one in there.frames]
    lengths = [0.0 if step is None else step.distance_m for step in steps]
    able = np.flatnonzero(np.cumsum(lengths[::-1])[::-1] >= _WITHIN_M)
    rows = np.linspace(0, len(able) - 1, min(count, len(able))).round().astype(int)
    return [int(at) for at in able[rows]]


def switched_on(there: Street, first: int) -> Count:
    """A robot that starts lost at a frame, until its first fix or for 10 m."""
    found: list[tuple[int, Localisation]] = []
    for looked in there.run(Try(Kind.COLD, first)):
        found.append((looked.frame, looked.found))
        if looked.found.localised or way_m(there.truth[first : looked.frame + 1]) >= _WITHIN_M:
            break
    return there.counted(found)


def could_be_found(there: Street, first: int, frames: int) -> Count:
    """One robot if matching with the nodes near finds one of the frames; none if not."""
    matcher = Lanes(there.opened.frames, there.settings.localiser.matcher)
    for at in range(first, first + frames):
        live = there.frames[at].frame
        live_id = node_id(there.live.session.id, live.stamp_ns)
        near = there.nodes.near(there.truth[at], _REACH_M + _WRONG_M)
        for node in sorted(near) if live.status is FrameStatus.OK else ():
            match = matcher.match(live, live_id, node, None)
            pose = match.reference_from_live
            if pose is None or match.inliers < _FINDABLE_INLIERS or pose.distance_m > _REACH_M:
                continue
            error = there.error(at, node, pose)
            if error is not None and error[0] <= _WRONG_M:
                return Count(robots=1)
    return Count()


_FIRST_ESTATE, _PERIODS_M = 501, (20.0, 30.0, 37.5)


def equal_fronts(asked: Asked) -> Iterator[Figure]:
    """Estates whose fronts repeat every 20, 30 and 37.5 m: robots next to the mapped street.

    One ring of each town is mapped (501 to 503, or from the first of `--towns` on). Robots drive
    along the ring next to it, `--live` of 2, 3, 5, 6, from `--trials` places (2): switched on
    there, or told that they are on the mapped one. Every fix is false. Then the ring alone and both
    rings are mapped, and wrong edges counted. Last, a later drive is localised on the mapped ring.
    """
    first = asked.towns[0] if asked.towns[0] >= _FIRST_ESTATE else _FIRST_ESTATE
    table, beside = Table("equal-fronts", asked), asked.live or tuple(BESIDE)
    for seed, period_m in enumerate(_PERIODS_M, first):
        town = estate(seed, fronts=Fronts(period_m))
        drives = drives_in(town, asked.settings, [MAPPED, AGAIN, *beside])
        here = partial(street, town, drives=drives, settings=asked.settings, lost_rounds=8)
        for kind, number in product((Kind.COLD, Kind.UNDISTURBED), beside):
            with closing(here(mapped=[MAPPED], live=drives[number])) as there:
                starts = np.linspace(0, len(there.frames), asked.trials or 2, endpoint=False)
                for start in starts.astype(int).tolist():
                    robot = partial(there.count, Try(kind, start))
                    table.add(f"{kind} on the unmapped street", f"{seed} {number} {start}", robot)
        for mapped in ([MAPPED], [MAPPED, *beside]):
            with closing(here(mapped=mapped, live=drives[AGAIN])) as there:
                name = f"{seed}, {len(mapped)} drives mapped"
                yield from edge_figures(name, there.opened, there.nodes.pose)
                if mapped == [MAPPED]:
                    robot = partial(there.count, Try(Kind.UNDISTURBED))
                    table.add("later, on the mapped street", str(seed), robot)
    yield from table.figures()


def wrong_places(asked: Asked) -> Iterator[Figure]:
    """Attempts of lost robots at places where they are not: how many would be accepted.

    Each tenth frame of each drive, or each `--trials`-th, is matched with every node of each map:
    all of another town's, and those 15 m or more away in its own.
    """
    every = asked.trials or 10
    tried = {True: [0, 0, 0, 0], False: [0, 0, 0, 0]}
    most = {True: -100.0, False: -100.0}
    for _, there in town_pairs(asked.towns, asked.settings):
        places = WrongPlaces(there, every)
        found, same = [one for _, one in places.lost()], there.same_town
        counts = (
            places.attempts,
            sum(one.match.inliers >= 20 for one in found),
            sum(one.accepted for one in found),
            sum(one.plausible and not one.accepted for one in found),
        )
        tried[same] = [a + b for a, b in zip(tried[same], counts, strict=True)]
        most[same] = max([most[same], *(one.confidence for one in found)])
        there.close()
    for name, same in (("same town, 15 m away or more", True), ("another town", False)):
        what = ("attempts", "false, 20 inliers or more", "accepted", "waiting for a second")
        for part, value in zip(what, tried[same], strict=True):
            yield Figure(f"{name}: {part}", value)
        yield Figure(f"{name}: most log-odds", most[same])


_HEALTHY, _FOCAL, _BASELINE = "as it is", "focal length", "baseline"
_CODES = {_FOCAL: "focal_length_off", _BASELINE: "baseline_off"}


def calibration(asked: Asked) -> Iterator[Figure]:
    """Whether a wrong focal length or baseline shows when a robot localises in a map.

    Every drive of a small town is localised in each map that it is no part of, from a true start:
    as it is, and with each fault, 8 to 30 % too long or too short, in the robot's calibration
    alone. Counted are warnings of the doctor, and what the map measures.
    """
    rows: dict[str, list[tuple[float, float | None, bool, Count]]] = {}
    for plan, name, there in all_streets(asked.towns, asked.settings):
        for fault in (_HEALTHY, _FOCAL, _BASELINE):
            rng = np.random.default_rng(zlib.crc32(f"{name} {fault}".encode()))
            share = float(np.exp(rng.uniform(np.log(0.08), np.log(0.3))))
            by = 1.0 if fault == _HEALTHY else float((1 + share) ** rng.choice([-1, 1]))
            one = (by, *miscalibrated(there, fault, by))
            for row in (fault, f"{fault}, {light_of(plan)}"):
                rows.setdefault(row, []).append(one)
        there.close()
    for name, found in rows.items():
        yield Figure(f"{name}: warned of {len(found)}", sum(alarm for _, _, alarm, _ in found))
        yield Figure("  cannot tell", sum(told is None for _, told, _, _ in found))
        errors = [abs(told / by - 1) for by, told, _, _ in found if told is not None]
        if errors:
            yield Figure("  error of the factor, median", 100 * float(np.median(errors)), "%")
        yield from figures_of(name, sum((one for *_, one in found), Count()))


def miscalibrated(there: Street, fault: str, by: float) -> tuple[float | None, bool, Count]:
    """Factor by the map, whether the doctor warns, and the fixes of the examined frames."""
    settings = there.settings
    camera: StereoCamera = there.frames[0].frame.camera
    if fault == _FOCAL:
        camera = replace(camera, fx=camera.fx * by, fy=camera.fy * by)
    elif fault == _BASELINE:
        camera = replace(camera, baseline_m=camera.baseline_m * by)
    odometry, found, front = Odometry(settings.odometry), [], Front(settings)
    with there.robot(camera=camera, front=front) as robot:
        start = there.nodes.start(there.truth[0])
        if start is not None:
            robot.place_at(start)
        for number, one in enumerate(there.frames[: settings.doctor.frames]):
            frame = replace(one.frame, camera=camera)
            found.append((number, robot.step(LoggedFrame(frame, odometry.step(frame)))))
        codes = {one.code for one in robot.diagnosis.findings}
        rematched = front.examination.evidence.rematched
    told = rematched.baseline_factor if fault == _BASELINE else rematched.focal_factor
    wanted = {_CODES[fault]} if fault in _CODES else set(_CODES.values())
    return told, bool(codes & wanted), there.counted(found)


@dataclass(slots=True)
class _Coverage:
    """Squared normalised errors in one weather: of fixes, odometry, 20 m of dead reckoning.

    `sharp` and `wrong_sharp`: steps that claim less than 0.1 m, and those of them 0.2 m off.
    """

    fixes: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)
    reckoned: list[float] = field(default_factory=list)
    sharp: int = 0
    wrong_sharp: int = 0


_WRONG_STEP_M, _SHARP_M, _RECKONED_M, _EVERY = 0.2, 0.1, 20.0, 5


def covariances(asked: Asked) -> Iterator[Figure]:
    """Share of errors within the ellipsoids that should hold 50, 90 and 99 %, by weather.

    Of right fixes of undisturbed robots in every map of a town, of steps of odometry, and of 20 m
    of dead reckoning, in all six degrees of freedom.
    """
    found: dict[str, _Coverage] = {}
    driven: set[NodeId | object] = set()
    for plan, _, there in all_streets(asked.towns, asked.settings):
        one = found.setdefault(light_of(plan), _Coverage())
        if there.live.session.id not in driven:
            driven.add(there.live.session.id)
            _add_motion(one, there)
        for looked in there.run(Try(Kind.UNDISTURBED)):
            fix, at = there.fix(0, looked.frame, looked.found), looked.found
            if fix is None or fix.false or at.covariance is None:
                continue
            assert at.node is not None
            assert at.node_from_live is not None
            world_from_node = there.nodes.pose(at.node)
            assert world_from_node is not None
            true = world_from_node.inverse() @ there.truth[looked.frame]
            one.fixes.append(squared(at.node_from_live, at.covariance, true))
        there.close()
    for weather, one in sorted(found.items()):
        kinds = {"fixes": one.fixes, "steps of odometry": one.steps}
        kinds["20 m of dead reckoning"] = one.reckoned
        for name, values in kinds.items():
            yield Figure(f"{weather}: {name}", len(values))
            for level in LEVELS if values else ():
                inside = np.array(values) <= chi2.ppf(level, 6)
                yield Figure(f"  within {100 * level:.0f} %", 100 * float(inside.mean()), "%")
        yield Figure(f"{weather}: sharp steps", one.sharp)
        yield Figure("  wrong ones among them", one.wrong_sharp)


def _add_motion(one: _Coverage, there: Street) -> None:
    """Measured steps of a drive, and stretches of dead reckoning from every fifth frame on."""
    gaps, truth = GapFiller(), there.truth
    last: int | None = None
    open_: list[tuple[int, Position]] = []
    nowhere = node_id(there.live.session.id, 0)
    for number, logged in enumerate(there.frames):
        landmarks = len(logged.frame.landmarks)
        motion = gaps.motion(logged.odometry, logged.frame.stamp_ns, landmarks=landmarks)
        if not motion.usable:
            continue
        step, covariance = motion.prev_from_curr, motion.covariance
        if step is not None and covariance is not None and last is not None:
            true = truth[last].inverse() @ truth[number]
            if not motion.guessed_m:
                sharp = _sigma_m(covariance) < _SHARP_M
                one.sharp += sharp
                one.wrong_sharp += sharp and (step.inverse() @ true).distance_m > _WRONG_STEP_M
                by_itself = logged.odometry
                if by_itself.prev_from_curr is not None and by_itself.covariance is not None:
                    one.steps.append(squared(by_itself.prev_from_curr, by_itself.covariance, true))
            open_ = [(start, at.carried_on(step, covariance)) for start, at in open_]
        elif last is not None:
            open_ = []
        for start, at in list(open_):
            true = truth[start].inverse() @ truth[number]
            if true.distance_m >= _RECKONED_M:
                one.reckoned.append(squared(at.node_from_live, at.covariance, true))
                open_.remove((start, at))
        if number % _EVERY == 0:
            open_.append((number, Position(nowhere, SE3.identity(), np.zeros((6, 6)))))
        last = number


def _sigma_m(covariance: NDArray[np.float64]) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))


QUESTIONS: dict[str, Callable[[Asked], Iterator[Figure]]] = {
    "hints": hints,
    "lost": lost,
    "undisturbed": roads,
    "right-fixes": right_fixes,
    "wheels": wheels,
    "blackouts": blackouts,
    "stalls": stalls,
    "cold-starts": cold_starts,
    "equal-fronts": equal_fronts,
    "wrong-places": wrong_places,
    "calibration": calibration,
    "covariances": covariances,
    "darker": darker,
    "standing": standing,
    "edges": edges,
    "saving": saving,
    "goals": goals,
    "memories": memories,
    "directions": directions,
    "mountings": mountings,
    "lenses": lenses,
    "dreams": dreams,
}
