"""What stands still before a camera: fixed patterns and frozen streams, in maps and in claims."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from engram.doctor.table import Severity
from engram.frontend.frame import StereoPair
from engram.frontend.frontend import Frontend
from engram.geometry.se3 import SE3
from engram.maps.map import open_map
from engram.odometry.odometry import Odometry
from engram.odometry.outside import OutsideMotion
from engram.robot.front import Front
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive
from engram_lab.accuracy import Count, Fix, way_m
from engram_lab.programs import Figure
from engram_lab.studies.faults.clips import Clip, ClipDrive, ClipPlan
from engram_lab.studies.faults.injected import (
    FixedPattern,
    NeverMoved,
    Shown,
    halved,
    on_both,
    undisturbed,
)
from engram_lab.studies.faults.staging import Place
from engram_lab.studies.faults.study import RealPlan
from engram_lab.studies.faults.table import Asked, figures_of

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
    for name, clip in clips():
        for contrast in _CONTRASTS:
            silent, count = 0, Count()
            for share, side in product(_SHARES, _SIDES):
                pattern = FixedPattern(side=side, depth_m=_DEPTH_M, contrast=contrast)
                rng = np.random.default_rng(_SIDES.index(side))
                short, one = mapped_and_driven(clip, pattern.apply(clip.pairs, share, 0, rng))
                silent, count = silent + short, count + one
            row = f"{name}, pattern of contrast {contrast}"
            yield Figure(f"{row}: short maps without a warning", silent, f"of {count.robots}")
            yield from figures_of(row, count)
        for what, shown, wheels in frozen(clip):
            _, one = mapped_and_driven(clip, shown, wheels, clean=True)
            yield from figures_of(f"{name}, {what}", one)
        for what, pairs in (("undisturbed", clip.pairs), ("parked", parked(clip))):
            front = Front(Settings())
            for pair in pairs:
                front.take(pair)
            yield Figure(f"{name}, {what}: learnt", front.fixed_share, "of the image")
            yield Figure(f"{name}, {what}: in doubt", front.doubts, "frames")


def clips() -> Iterator[tuple[str, Clip]]:
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


Wheels = Sequence[OutsideMotion]


def frozen(clip: Clip) -> Iterator[tuple[str, list[Shown], Wheels | None]]:
    """Streams that freeze, with and without what wheels measure at each frame."""
    poses = clip.world_from_cam
    wheels = [OutsideMotion(a.inverse() @ b, 0.1) for a, b in pairwise([poses[0], *poses])]
    for burnt_in, outside in product((False, True), (None, wheels)):
        never = NeverMoved(burnt_in=burnt_in)
        shown = never.apply(clip.pairs, len(clip), 0, np.random.default_rng(0))
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
    clip: Clip, shown: Sequence[Shown], outside: Wheels | None = None, *, clean: bool = False
) -> tuple[bool, Count]:
    """Maps every other frame, and localises the others in the map.

    Args:
        clip: the truth.
        shown: the frames as a robot meets them.
        outside: what wheels measure at each frame that is localised; None without wheels.
        clean: whether the undisturbed frames are mapped, and all others localised.

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
