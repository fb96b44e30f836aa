"""Worlds, drives, maps and robots for all tests.

A world is points with descriptors, seen by an ideal front-end: frames without images. Fast and
exact, for tests of what comes after the front-end. Each appearance of a world has descriptors of
its own, so that frames of different appearances never match.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from sqlalchemy import Engine, event

from engram.frontend.blobs import landmarks_from_codes, pixel_quantum, quantise
from engram.frontend.frame import BRIEF, Frame, FrameStatus
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import (
    Attempt,
    Clock,
    Edge,
    EdgeKind,
    NodeId,
    Session,
    SessionId,
    path_id,
    session_id,
)
from engram.localiser.localisation import Budget, Localisation
from engram.localiser.localiser import Localiser
from engram.mapper.mapper import Mapper, Saver
from engram.maps.map import Map, open_map
from engram.maps.records import MapContents
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.drive_session import RevisionSink, loop_search
from engram.robot.front import Front
from engram.robot.localisers import localiser_in
from engram.robot.robot import Robot
from engram.robot.settings import Settings
from engram.sequences.sequence import LoggedFrame
from engram_lab.bench.data import synthetic_drive

CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.3, 640, 480)
PERIOD_NS = 50_000_000


@dataclass
class World:
    """Walls of points on both sides of a road that follows `pose_at`.

    Attributes:
        length_m: of the road.
        radius_m: the road is a circle of this radius; infinite for a straight one.
        seed: of points and descriptors.
    """

    length_m: float = 60.0
    radius_m: float = np.inf
    seed: int = 0
    points: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        count = int(60 * self.length_m)
        along = rng.uniform(-10, self.length_m + 40, count)
        side = rng.choice([-1.0, 1.0], count) * rng.uniform(4.0, 7.0, count)
        height = rng.uniform(-4.0, 1.5, count)
        if np.isinf(self.radius_m):
            self.points = np.column_stack([side, height, along])
            return
        self.points = np.array(
            [
                self.pose_at(s) @ np.array([x, y, 0.0])
                for s, x, y in zip(along, side, height, strict=True)
            ]
        )

    def pose_at(self, s_m: float, aside_m: float = 0.0) -> SE3:
        """``world_from_camera`` after `s_m` of road, looking along it."""
        if np.isinf(self.radius_m):
            return SE3(np.eye(3), np.array([aside_m, 0.0, s_m]))
        angle = s_m / self.radius_m
        turn = SE3.exp([0, 0, 0, 0, angle, 0])
        centre = np.array([self.radius_m, 0.0, 0.0])
        arm = turn.rotation @ np.array([-self.radius_m + aside_m, 0.0, 0.0])
        return SE3(turn.rotation, centre + arm)

    def descriptors(self, appearance: int) -> np.ndarray:
        """(P, 32) uint8 of all points in one appearance of the world."""
        return _random_descriptors(len(self.points), self.seed, appearance)


# A front of `Copied`.
_FRONT_M = 6.0


class Sparse(World):
    """A street of which a frame shows all that is in view."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.points = self.points[::4]


class Copied(Sparse):
    """A street that shares some of the points of another one, and looks of them to the bit.

    It shares whole places, as equal fronts do, or here and there a point, as in rain.
    """

    def __init__(self, of: World, share: float, *, evenly: bool = False) -> None:
        super().__init__(of.length_m, seed=of.seed)
        other = Sparse(of.length_m, seed=of.seed + 100)
        rng = np.random.default_rng(3)
        place = np.unique(np.floor(self.points / _FRONT_M), axis=0, return_inverse=True)[1].ravel()
        number = np.arange(len(self.points)) if evenly else place
        self._same = rng.random(number.max() + 1)[number] < share
        self._other = other
        self.points = np.where(self._same[:, None], self.points, other.points)

    def descriptors(self, appearance: int) -> np.ndarray:
        own, other = super().descriptors(appearance), self._other.descriptors(appearance)
        return np.where(self._same[:, None], own, other)


@lru_cache(maxsize=8)
def _random_descriptors(count: int, seed: int, appearance: int) -> np.ndarray:
    rng = np.random.default_rng([seed, appearance])
    drawn = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    drawn.setflags(write=False)
    return drawn


def see(
    world: World,
    world_from_cam: SE3,
    stamp_ns: int,
    appearance: int = 0,
    noise_px: float = 0.3,
    camera: StereoCamera = CAMERA,
    count: int = 400,
) -> Frame:
    """The frame that an ideal front-end would make there, with noise of pixels and bits."""
    rng = np.random.default_rng([world.seed, stamp_ns & 0xFFFFFFFF, appearance])
    points = world_from_cam.inverse() @ world.points
    depth = points[:, 2]
    safe = np.maximum(depth, 0.1)
    u = camera.fx * points[:, 0] / safe + camera.cx
    v = camera.fy * points[:, 1] / safe + camera.cy
    seen = (depth > 2) & (depth < 40) & (u > 5) & (u < camera.width - 6)
    rows = np.flatnonzero(seen & (v > 5) & (v < camera.height - 6))
    rows = rng.permutation(rows)[:count]
    noisy = np.stack([u, v, camera.focal_baseline / safe], axis=1)[rows]
    noisy += rng.normal(0, noise_px, noisy.shape) * [1, 1, 0.5]
    flips = np.packbits(rng.random((len(rows), 256)) < 0.05, axis=1)
    codes = quantise(
        noisy[:, :2].astype(np.float32),
        np.maximum(noisy[:, 2], 0.1).astype(np.float32),
        np.full(len(rows), 0.15, np.float32),
        pixel_quantum(camera.width, camera.height),
    )
    landmarks = landmarks_from_codes(
        codes,
        world.descriptors(appearance)[rows] ^ flips,
        np.zeros(len(rows), np.uint8),
        camera,
    )
    status = FrameStatus.OK if len(rows) >= 30 else FrameStatus.TOO_FEW_LANDMARKS
    return Frame(stamp_ns, camera, landmarks, BRIEF, "synthetic", status)


@dataclass(frozen=True)
class Seen:
    """One step of a simulated drive."""

    frame: Frame
    odometry: OdometryStep
    world_from_live: SE3

    @property
    def logged(self) -> LoggedFrame:
        """As a frame log has it."""
        return LoggedFrame(self.frame, self.odometry)


def drive(
    world: World,
    places_m: np.ndarray,
    appearance: int | np.ndarray = 0,
    aside_m: float = 0.0,
    start_ns: int = 1_000_000_000_000,
    seed: int = 0,
    camera: StereoCamera = CAMERA,
    drift: SE3 | None = None,
) -> list[Seen]:
    """Drives past the places given, with odometry of 1 % and 0.1° of noise a step.

    `drift` is added to every step; the covariance knows nothing of it.
    """
    rng = np.random.default_rng([world.seed, seed])
    appearances = np.broadcast_to(appearance, len(places_m))
    steps: list[Seen] = []
    for i, s in enumerate(places_m):
        truth = world.pose_at(float(s), aside_m)
        frame = see(world, truth, start_ns + i * PERIOD_NS, int(appearances[i]), camera=camera)
        if i == 0:
            odometry = OdometryStep(OdometryStatus.FIRST)
        else:
            motion = steps[-1].world_from_live.inverse() @ truth
            sigma_m = 0.003 + 0.01 * motion.distance_m
            sigma = np.array([sigma_m] * 3 + [np.deg2rad(0.1)] * 3)
            noisy = SE3.exp(rng.normal(0, sigma)) @ motion @ (drift or SE3.identity())
            odometry = OdometryStep(OdometryStatus.OK, noisy, np.diag(sigma**2), 100)
        steps.append(Seen(frame, odometry, truth))
    return steps


# The world and the road of the fixture `town`.
TOWN, TOWN_ROAD = World(30.0), np.arange(0.0, 25.0, 0.7)


def dies_before(statement: int, work: Callable[[], object]) -> bool:
    """Runs `work` in a child that dies before its n-th SQL statement; whether it died."""
    child = os.fork()
    if child:
        return os.WIFSIGNALED(os.waitpid(child, 0)[1])
    left = statement

    def die(*_: object) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)

    try:
        event.listen(Engine, "before_cursor_execute", die)
        work()
    finally:
        os._exit(0)


def write_street(folder: Path, frames: int) -> Path:
    """Pairs of a rendered street in the plain layout, 0.8 m apart."""
    pairs = synthetic_drive(frames=frames, step_m=0.8)
    camera = pairs[0].camera
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
        for number, pair in enumerate(pairs):
            cv2.imwrite(str(folder / side / f"{number:06d}.png"), getattr(pair, side))
    stamps = "".join(f"{number / 10:.6f}\n" for number in range(len(pairs)))
    (folder / "times.txt").write_text(stamps)
    names = ("width", "height", "fx", "fy", "cx", "cy", "baseline_m")
    lines = ["[rectified]", *(f"{name} = {getattr(camera, name)}" for name in names), ""]
    (folder / "calibration.toml").write_text("\n".join(lines))
    return folder


def covariance_of(sigma_m: float, sigma_rad: float) -> np.ndarray:
    return np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)


def make_edge(a: NodeId, b: NodeId, a_from_b: SE3, kind=EdgeKind.ODOMETRY, sigma=(0.02, 0.001)):
    return Edge(a, b, kind, a_from_b, covariance_of(*sigma))


def forward(metres: float, across_m: float = 0.0, yaw_rad: float = 0.0) -> SE3:
    """A pose ahead, to the right, and turned to the right."""
    turn = SE3.exp([0, 0, 0, 0, yaw_rad, 0])
    return SE3(turn.rotation, np.array([across_m, 0.0, metres]))


def attempts_of(contents: MapContents, session: SessionId) -> list[Attempt]:
    """The remembered attempts of one session as records."""
    made = contents.attempts
    place = next((at for at, one in enumerate(contents.sessions) if one.id == session), -1)
    return [
        Attempt(
            iteration=int(made.iteration[row]),
            reference=contents.nodes[made.reference[row]].id,
            node=contents.nodes[made.node[row]].id,
            along_m=float(made.along_m[row]),
            across_m=float(made.across_m[row]),
            yaw_rad=float(made.yaw_rad[row]),
            sigma_m=float(made.sigma_m[row]),
            sigma_yaw_rad=float(made.sigma_yaw_rad[row]),
            accepted=bool(made.accepted[row]),
            inliers=int(made.inliers[row]),
            rank=int(made.rank[row]),
            policy=made.policies[made.policy[row]],
        )
        for row in np.flatnonzero(made.session == place)
    ]


@dataclass
class Mapped:
    """What mapping a drive came to, beside the truth."""

    steps: list[Localisation]
    drive: list[Seen]

    @property
    def statuses(self) -> list[str]:
        return [step.status.value for step in self.steps]

    @property
    def saved(self) -> dict[NodeId, SE3]:
        """Truth of each node that was saved."""
        return {
            step.saved: seen.world_from_live
            for step, seen in zip(self.steps, self.drive, strict=True)
            if step.saved is not None
        }


def session_for(drive: list[Seen], name: str, longitude_deg: float | None = None) -> Session:
    """The session of a drive; its stamps are of UTC where a longitude is given."""
    first = drive[0].frame
    return Session(
        session_id(name, first.camera.id, first.stamp_ns, name),
        name,
        first.camera.id,
        first.stamp_ns,
        Clock.RELATIVE if longitude_deg is None else Clock.UTC,
        longitude_deg,
    )


def map_simulated(
    path: Path,
    drive: list[Seen],
    name: str = "r1",
    policy: str = "path",
    *,
    closes_loops: bool = False,
    longitude_deg: float | None = None,
    settings: Settings | None = None,
    **budget: int,
) -> Mapped:
    first, settings = drive[0].frame, settings or Settings()
    with open_map(path, create=True) as opened, opened.writing():
        session = session_for(drive, name, longitude_deg)
        writer = opened.begin_session(
            session,
            first.camera,
            descriptor=first.descriptor,
            frontend=first.frontend,
            author=name,
            configuration={},
        )
        sink = RevisionSink(writer, opened.frames, None, settings.placing)
        saver = Saver(sink, path_id(session.id))
        localiser = localiser_in(
            opened,
            first.camera,
            settings,
            policy=policy,
            budget=Budget(**budget),
            live=session.id,
            saves=True,
        )
        loops = loop_search(opened, localiser, settings) if closes_loops else None
        with localiser, loops or nullcontext():
            mapper = Mapper(localiser.graph, localiser, saver, session, settings.mapper, loops)
            robot = Robot(Front(settings), localiser, mapper)
            steps = [robot.step(seen.logged) for seen in drive]
            mapper.finish()
        saver.finish()
        writer.commit(settings.placing)
    return Mapped(steps, drive)


def localised(localiser: Localiser, drive: Iterable[Seen]) -> list[Localisation]:
    """What a localiser finds of frames, one after another."""
    robot = Robot(Front(Settings()), localiser)
    return [robot.step(seen.logged) for seen in drive]


def localise_simulated(
    path: Path,
    drive: list[Seen],
    policy: str = "path",
    relocaliser: str | None = "exhaustive",
    budget: Budget | None = None,
) -> list[Localisation]:
    with Map.open(path) as opened:
        localiser = localiser_in(
            opened,
            drive[0].frame.camera,
            Settings(),
            policy=policy,
            budget=budget,
            relocaliser=relocaliser,
        )
        with localiser:
            return localised(localiser, drive)


def errors_m(found: list[Localisation], drive: list[Seen], nodes: dict[NodeId, SE3]) -> np.ndarray:
    """Distance between measured and true position of each localised frame."""
    return np.array(
        [
            np.linalg.norm(
                (nodes[one.node].inverse() @ seen.world_from_live).translation
                - one.node_from_live.translation
            )
            for one, seen in zip(found, drive, strict=True)
            if one.node is not None
        ]
    )
