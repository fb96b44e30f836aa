"""What stands still before a camera: fixed patterns and frozen streams, in maps and in claims.

Every other frame of a clip is mapped, the others are localised in that map, both with the same
thing fixed to the camera, from one of four sides, of growing size and contrast. Counted are the
drives whose map lacks more than a tenth of the way without a warning, and false fixes. Then the
picture is frozen from the start, or at rest while wheels turn. Sound drives show what is learnt
where nothing is fixed.

Clips: KITTI 06, with its truth; KITTI raw 0001, against odometry of the undisturbed drive; a street
that is rendered. The real ones need ENGRAM_DATA.

python -m engram_lab.checks.standing [--only CLIP] [--json FILE]
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path

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
from engram_lab.bench.data import synthetic_drive
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.faults.clips import Clip, ClipDrive, ClipPlan
from engram_lab.studies.faults.injected import (
    FixedPattern,
    NeverMoved,
    Shown,
    halved,
    on_both,
    undisturbed,
)
from engram_lab.studies.faults.study import RealPlan

SHARES, CONTRASTS = (0.1, 0.2, 0.35, 0.6), (0.25, 0.5, 1.0)
SIDES = ("bottom", "top", "left", "right")
FALSE_M = 1.0
_DEPTH_M = 2.4


@dataclass(slots=True)
class Count:
    """The results of some drives.

    Attributes:
        drives: how many were mapped.
        silent: those that lack more than a tenth of the way, without a finding of the doctor.
        fixes, false: of the drives localised.
        frames: of these.
        worst_m: the largest error of a fix.
    """

    drives: int = 0
    silent: int = 0
    frames: int = 0
    fixes: int = 0
    false: int = 0
    worst_m: float = 0.0


def clips() -> Iterator[tuple[str, Clip]]:
    """The clips, at half size, by name."""
    plan = ClipPlan("street", 0, 0)
    pairs = [_with_noise(halved(one, 2.0), k) for k, one in enumerate(synthetic_drive(40, 0.8))]
    poses = [SE3(np.eye(3), np.array([0.0, 0.0, 0.8 * k])) for k in range(40)]
    yield "street", Clip(plan, pairs, poses)
    named = os.environ.get("ENGRAM_DATA")
    if not named:
        return
    data = Path(named)
    there = RealPlan("kitti-06", "mapped", data).read(), RealPlan("kitti-06", "there", data).read()
    half = len(there[0])
    yield (
        "kitti-06",
        _interleaved(
            there[0], Clip(plan, there[1].pairs[: half - 1], there[1].world_from_cam[: half - 1])
        ),
    )
    drive = open_drive(data / "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync")
    raw = [halved(one, 2.0) for one in drive if isinstance(one, StereoPair)]
    yield "raw-0001", Clip(plan, raw, _seen(raw))


def _interleaved(mapped: Clip, driven: Clip) -> Clip:
    frames: list[tuple[StereoPair, SE3]] = []
    for k, frame in enumerate(zip(mapped.pairs, mapped.world_from_cam, strict=True)):
        frames.append(frame)
        if k < len(driven):
            frames.append((driven.pairs[k], driven.world_from_cam[k]))
    pairs = [replace(halved(one, 2.0), stamp_ns=k * 10**8) for k, (one, _) in enumerate(frames)]
    return Clip(mapped.plan, pairs, [pose for _, pose in frames])


def _seen(pairs: Sequence[StereoPair]) -> list[SE3]:
    """Poses by odometry."""
    frontend, odometry, pose = Frontend(), Odometry(), SE3.identity()
    poses = []
    for pair in pairs:
        step = odometry.step(frontend.extract(pair)).prev_from_curr
        pose = pose if step is None else pose @ step
        poses.append(pose)
    return poses


def _with_noise(pair: StereoPair, seed: int) -> StereoPair:
    rng = np.random.default_rng(seed)
    return on_both(
        pair, lambda one: np.clip(one + rng.normal(0, 1.0, one.shape), 0, 255).astype(np.uint8)
    )


def mapped_and_driven(
    clip: Clip,
    shown: Sequence[Shown],
    count: Count,
    told: Sequence[OutsideMotion | None] | None = None,
    *,
    clean: bool = False,
) -> None:
    """Maps every other frame, localises all others in the map; adds to a count.

    Args:
        clip: the truth.
        shown: the frames as a robot meets them.
        count: what is added to.
        told: what wheels say at each frame that is localised; None without wheels.
        clean: whether the undisturbed frames are mapped.
    """
    source = undisturbed(clip.pairs) if clean else shown
    live = list(shown) if clean else list(shown[1::2])
    with tempfile.TemporaryDirectory(prefix="engram-standing-") as folder:
        path = Path(folder) / "map.engram"
        drive = ClipDrive(clip.plan, [one.pair for one in source[::2]])
        made = map_drive(path, drive, Settings(), RobotOptions(force=True))
        assert made.diagnosis is not None
        true = {one.pair.stamp_ns: clip.world_from_cam[one.frame] for one in source}
        warned = any(one.severity is not Severity.NOTE for one in made.diagnosis.findings)
        with open_map(path) as opened:
            way_m = sum(edge.a_from_b.distance_m for edge in opened.graph.edges)
            count.drives += 1
            count.silent += not warned and way_m < 0.9 * _way_m(clip)
            with opened.robot(clip.pairs[0].camera) as robot:
                for k, one in enumerate(live):
                    pair = replace(one.pair, stamp_ns=one.pair.stamp_ns + 10**12)
                    found = robot.step(pair, motion=told[k] if told and k else None)
                    count.frames += 1
                    if found.node is None or found.node_from_live is None:
                        continue
                    node = opened.graph.node(opened.graph.index(found.node))
                    right = true[node.stamp_ns].inverse() @ clip.world_from_cam[one.frame]
                    off_m = float(
                        np.linalg.norm(found.node_from_live.translation - right.translation)
                    )
                    count.fixes += 1
                    count.false += off_m > FALSE_M
                    count.worst_m = max(count.worst_m, off_m)


def _way_m(clip: Clip) -> float:
    poses = clip.world_from_cam[::2]
    return sum((a.inverse() @ b).distance_m for a, b in pairwise(poses))


def patterns(clip: Clip, contrast: float) -> Count:
    """Fixed patterns of one contrast, of all sizes and sides."""
    count = Count()
    for share, side in product(SHARES, SIDES):
        pattern = FixedPattern(side=side, depth_m=_DEPTH_M, contrast=contrast)
        shown = pattern.apply(clip.pairs, share, 0, np.random.default_rng(SIDES.index(side)))
        mapped_and_driven(clip, shown, count)
    return count


def frozen(clip: Clip) -> Iterator[tuple[str, Count]]:
    """Streams that freeze, with and without wheels."""
    pairs, poses = clip.pairs, clip.world_from_cam
    wheels = [
        OutsideMotion(a.inverse() @ b, 0.1) for a, b in zip([poses[0], *poses], poses, strict=False)
    ]
    for burnt_in, told in product((False, True), (None, wheels)):
        shown = NeverMoved(burnt_in=burnt_in).apply(pairs, len(pairs), 0, np.random.default_rng(0))
        count = Count()
        mapped_and_driven(clip, shown, count, told, clean=True)
        stamp, by = " with a burnt-in time" if burnt_in else "", ", wheels" if told else ""
        yield f"frozen from the start{stamp}{by}", count
    for noise in (False, True):
        rest = [_with_noise(pairs[0], k) for k in range(5)]
        after = [_with_noise(rest[-1], 10 + k) if noise else rest[-1] for k in range(len(pairs))]
        shown = [
            Shown(max(0, k - 4), replace(one, stamp_ns=k * 10**8))
            for k, one in enumerate([*rest, *after[:-5]])
        ]
        still = OutsideMotion(SE3.identity(), 0.1)
        count = Count()
        mapped_and_driven(clip, shown, count, [still] * 5 + wheels[1:], clean=True)
        yield f"frozen at rest, wheels turn{', noise added' if noise else ''}", count


def sound(clip: Clip) -> Iterator[Figure]:
    """What is learnt of an undisturbed drive, and of a robot at rest."""
    parked = [
        replace(_with_noise(clip.pairs[0], k), stamp_ns=k * 10**8) for k in range(len(clip) * 5)
    ]
    for name, pairs in (("undisturbed", clip.pairs), ("parked", parked)):
        front = Front(Settings())
        for pair in pairs:
            front.take(pair)
        yield Figure(f"{name}: learnt, share of the image", front.fixed_share)
        yield Figure(f"{name}: in doubt", front.doubts, "frames")


def figures(only: str | None = None) -> Iterator[Figure]:
    """All of it, clip by clip; None for all clips."""
    for name, clip in clips():
        if only not in {None, name}:
            continue
        for contrast in CONTRASTS:
            yield from _told(f"{name}: pattern, contrast {contrast}", patterns(clip, contrast))
        for what, count in frozen(clip):
            yield from _told(f"{name}: {what}", count)
        for one in sound(clip):
            yield replace(one, name=f"{name}: {one.name}")


def _told(name: str, count: Count) -> Iterator[Figure]:
    yield Figure(f"{name}: short maps without a warning", count.silent, f"of {count.drives}")
    yield Figure(f"{name}: false fixes", count.false, f"of {count.fixes}, {count.frames} frames")
    yield Figure(f"{name}: largest error", count.worst_m, "m")


def main() -> None:
    """Prints the figures."""
    parser = command_line(__doc__)
    parser.add_argument("--only", metavar="CLIP", help="street, kitti-06 or raw-0001")
    asked = parser.parse_args()
    report(figures(asked.only), asked.json, "standing")


if __name__ == "__main__":
    main()
