"""Short rendered drives with images and truth, kept in the user's cache: rendered once, read often.

A clip is a stretch of a small town, seen by one rig on one day. Limits are set on the clips of
`SETTING`, and judged on those of `JUDGING`: other towns, and rigs that the limits never saw. The
doctor is judged on the shorter ones of `DOCTORED`, twenty drives of each rig.

python -m engram_lab.studies.faults.clips             # renders what is missing
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from engram.cli.screen import Bars
from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import Clock
from engram.monitor import QUIET, Monitor, write_whole
from engram.sequences.sequence import SequenceInfo
from engram_lab.town.campaigns import WORLD_VERSION, SessionPlan, campaign_named
from engram_lab.town.drive import ROBOTS, Robot
from engram_lab.town.session import SimulatedDrive
from engram_lab.town.simulating import campaigns_folder

RIGS: dict[str, Robot] = {
    **ROBOTS,
    "shuttle": Robot(
        "shuttle",
        StereoCamera(381.36, 381.36, 319.5, 239.5, 0.30, 640, 480),
        height_m=2.1,
        pitch_rad=0.05,
    ),
}
# The drive that is mapped: a clear morning, number 1 of the village's.
MAPPED = 1
# Weathers and hours of the others, by their numbers in the village, dealt to the towns in turn.
_OTHERS = (4, 6, 12, 9, 21, 17, 5, 7, 10, 0, 20, 22, 3, 18, 13, 8, 2, 19, 23, 14)
_LIVE = 5


@dataclass(frozen=True, slots=True)
class ClipPlan:
    """What a clip shows."""

    rig: str
    town: int
    session: int
    start: int = 20
    count: int = 100
    reverse: bool = False

    @property
    def name(self) -> str:
        """Such as ``wildcat-31-04``."""
        return f"{self.rig}-{self.town}-{self.session:02d}{'-reverse' if self.reverse else ''}"

    def path(self, folder: Path | None = None) -> Path:
        """Where it is kept."""
        return (folder or campaigns_folder()) / f"clips-v{WORLD_VERSION}" / f"{self.name}.npz"

    @property
    def mapped(self) -> bool:
        """Whether the map of the town is made of it."""
        return self.session == MAPPED

    def read(self, folder: Path | None = None) -> Clip:
        """The clip from the cache, rendered first if it is not there."""
        path = self.path(folder)
        if not path.exists():
            _render(self, path)
        with np.load(path) as kept:
            left, right, stamps, poses = (kept[key] for key in ("left", "right", "stamps", "poses"))
        camera = RIGS[self.rig].camera
        pairs = [
            StereoPair(int(stamp), left[k], right[k], camera)
            for k, stamp in enumerate(stamps.tolist())
        ]
        return Clip(self, pairs, [SE3.from_matrix(pose) for pose in poses])


class Plan(Protocol):
    """What a clip shows, rendered or real."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def rig(self) -> str: ...  # noqa: D102
    @property
    def town(self) -> int | str: ...  # noqa: D102
    @property
    def mapped(self) -> bool: ...  # noqa: D102
    @property
    def reverse(self) -> bool: ...  # noqa: D102
    def read(self) -> Clip:
        """The clip."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Clip:
    """A clip with its truth."""

    plan: Plan
    pairs: list[StereoPair]
    world_from_cam: list[SE3]

    def __len__(self) -> int:
        return len(self.pairs)


class ClipDrive:
    """Frames of a clip as a `StereoSequence`.

    As a reader under ``skip_bad`` it leaves out frames that are not later than the one before.
    """

    def __init__(self, plan: Plan, pairs: Sequence[StereoPair]) -> None:
        newest = accumulate((pair.stamp_ns for pair in pairs), max, initial=-1)
        self._pairs = [one for one, last in zip(pairs, newest, strict=False) if one.stamp_ns > last]
        self.skipped = len(pairs) - len(self._pairs)
        self.info = SequenceInfo(plan.name, "clip", Clock.RELATIVE, plan.rig)

    @property
    def camera(self) -> StereoCamera:
        """Of all pairs."""
        return self._pairs[0].camera

    def __len__(self) -> int:
        return len(self._pairs)

    def __iter__(self) -> Iterator[StereoPair]:
        return iter(self._pairs)


def clips_of(towns: tuple[tuple[int, str], ...], count: int) -> list[ClipPlan]:
    """The mapped drive of each town, then some others of other days."""
    plans = []
    for town, rig in towns:
        first = (town - 1) * _LIVE % (10 * _LIVE)
        others = [_OTHERS[(first + k) % len(_OTHERS)] for k in range(_LIVE)]
        frames = count // 2 if rig == "kitti" else count  # of three times as many pixels
        plans += [ClipPlan(rig, town, one, count=frames) for one in (MAPPED, *others)]
    return plans


SETTING = [
    *clips_of(((21, "wildcat"), (22, "courier")), 60),
    *clips_of(((31, "wildcat"), (32, "courier")), 80),
]
JUDGING = clips_of(
    (
        (33, "bicycle"), (34, "kitti"), (35, "shuttle"),
        (36, "wildcat"), (37, "courier"), (38, "bicycle"), (39, "kitti"), (40, "shuttle"),
    ),
    80,
)  # fmt: skip
# One clip of each judged town against the direction of its map, each of another live day.
REVERSED = [
    replace(JUDGING[first + 1 + town % _LIVE], reverse=True)
    for town, first in enumerate(range(0, len(JUDGING), 1 + _LIVE))
]

# Twenty drives of each rig, other days of the village, in two towns that nothing else shows.
DOCTORED = [
    ClipPlan(rig, town, session, count=24)
    for rig, first in (
        ("bicycle", 71), ("kitti", 73), ("shuttle", 75), ("wildcat", 77), ("courier", 79)
    )
    for town, sessions in ((first, _OTHERS[:10]), (first + 1, _OTHERS[10:]))
    for session in sessions
]  # fmt: skip


def _render(plan: ClipPlan, path: Path) -> None:
    drive = drive_of(plan)
    start = _reversed_start(plan, drive) if plan.reverse else plan.start
    stop = start + plan.count
    pairs = list(drive.frames(start, stop))
    poses: list[NDArray[np.float64]] = [one.matrix() for one in drive.world_from_cams()[start:stop]]
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_whole(path) as draft, draft.open("wb") as file:
        np.savez(
            file,
            left=np.array([one.left for one in pairs]),
            right=np.array([one.right for one in pairs]),
            stamps=np.array([one.stamp_ns for one in pairs], np.int64),
            poses=np.array(poses),
        )


def _reversed_start(plan: ClipPlan, drive: SimulatedDrive) -> int:
    """The frame of a drive in the opposite direction that is nearest to the end of the stretch."""
    forwards = drive_of(replace(plan, reverse=False)).world_from_cams()
    end = forwards[plan.start + plan.count - 1].translation
    return int(
        np.argmin([np.linalg.norm(one.translation - end) for one in drive.world_from_cams()])
    )


def drive_of(plan: ClipPlan) -> SimulatedDrive:
    """The whole drive that a clip is a part of: the village's day on the hamlet's route."""
    town = campaign_named("hamlet", plan.town)
    days: tuple[SessionPlan, ...] = campaign_named("village", plan.town).sessions
    sessions = tuple(replace(day, reverse=plan.reverse) for day in days)
    return SimulatedDrive(replace(town, sessions=sessions), plan.session, robot=RIGS[plan.rig])


def missing(plans: list[ClipPlan]) -> Iterator[ClipPlan]:
    """Those that are not in the cache."""
    return (plan for plan in plans if not plan.path().exists())


def render(plans: list[ClipPlan], monitor: Monitor = QUIET) -> None:
    """Renders those that are not in the cache."""
    left = list(missing(plans))
    if not left:
        return
    with monitor.stage("clips", len(left)) as part:
        for plan in left:
            _render(plan, plan.path())
            part.advance(plan.name)
            part.check()


def main() -> None:
    """Renders what is not in the cache, and reports it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.parse_args()
    render([*SETTING, *JUDGING, *REVERSED, *DOCTORED], Bars())


if __name__ == "__main__":
    main()
