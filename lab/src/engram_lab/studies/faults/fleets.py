"""Questions about maps that are built drive after drive or merged: edges, routes missed, goals."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from engram.errors import ConfigError
from engram.fleet.dream import DreamOptions, dream, localised_in
from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.merging import merge
from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.basin import DEFAULT_RADIUS_M
from engram.graph.model import EdgeKind, Goal, NodeId, SessionId
from engram.graph.neighbourhood import Search
from engram.graph.placing import fit_level
from engram.localiser.localisation import Localisation
from engram.mapper.mapper import MapperConfig
from engram.maps.map import Map
from engram.maps.map_files import copy_map
from engram.maps.map_frame import FramePose
from engram.measures import Drive, route_not_localised
from engram.monitor import QUIET
from engram.robot.localisers import session_of_drive
from engram.robot.mapping import extract_log, map_drive
from engram.robot.settings import RobotOptions, Settings, load_settings
from engram.robot.starting import measure, robot_on
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.opening import open_drive
from engram_lab.accuracy import FALSE_M, Count, Fix, is_false
from engram_lab.programs import Figure
from engram_lab.studies.building import edge_errors
from engram_lab.studies.drives import EvaluatedDrive, TrueNodes, Truth
from engram_lab.studies.faults.table import Asked, Table, paired
from engram_lab.studies.streets import campaign_of, drives_in, light_of, trial_town
from engram_lab.town.campaigns import Campaign
from engram_lab.town.session import SimulatedSequence
from engram_lab.town.simulating import campaign_folder, campaigns_folder

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
        laid = store.frame.positions[known]
    return np.asarray(np.linalg.norm((fit_level(laid, places) @ laid - places)[:, :2], axis=1))
