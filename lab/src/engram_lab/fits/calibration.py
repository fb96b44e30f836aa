"""How hard the world is, by the reference matcher, on a loop of 0.15 km.

The world's difficulty was set once, before any evaluation, against facts from outside
(`lab/reports/town.md`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.config import config_hash
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.monitor import QUIET, Monitor
from engram_lab.fits.reference_matcher import (
    SUCCESS_INLIERS,
    ReferenceFrame,
    reference_frame,
    reference_match,
)
from engram_lab.town.camera_model import CONSTANTS
from engram_lab.town.campaigns import WORLD_VERSION
from engram_lab.town.conditions import WEATHERS
from engram_lab.town.drive import ROBOTS, DrivingStyle
from engram_lab.town.rendering import VISITS, Places, Visit
from engram_lab.town.textures import Style

MAPPED = "morning"
# The towns that the knobs were set on, and two that were looked at only afterwards.
TUNED_TOWNS = (1, 2, 3)
UNSEEN_TOWNS = (4, 5)
# KITTI 06 from frame 0 to 50, with which row (e) compares: the mean way between two frames.
CLIP_FRAMES = 51
CLIP_SPACING_M = 1.197
CLIP_STEPS = (1, 2, 4, 6)


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table.

    Attributes:
        letter: of the requirement.
        what: map against live.
        value: measured.
        low, high: between which facts from outside put it.
        unit: of the value.
    """

    letter: str
    what: str
    value: float
    low: float
    high: float
    unit: str

    def text(self) -> str:
        """A line for people."""
        bounds = f"{self.low:.3g} to {self.high:g}"
        return f"{self.letter}  {self.what:42} {self.value:8.2f} {self.unit:10} ({bounds})"


def world_hash() -> str:
    """Changes with the world's version, and with what sets its difficulty."""
    return config_hash(
        {
            "version": WORLD_VERSION,
            "style": Style(),
            "weathers": WEATHERS,
            "robots": ROBOTS,
            "driving": DrivingStyle(0),
            "camera": CONSTANTS,
        }
    )


Frames = list[tuple[SE3, ReferenceFrame]]


def reference_frames(
    places: Places, visit: Visit, ahead_m: float = 0.0, aside_m: float = 0.0
) -> Frames:
    """True pose and reference frame at each place."""
    return [(pose, reference_frame(pair)) for pose, pair in places.pairs(visit, ahead_m, aside_m)]


def inliers_of(node_frames: Frames, live_frames: Frames) -> NDArray[np.int64]:
    """(P,) inliers of each place of one visit matched against the same place of another.

    0 where the pose is wrong.
    """
    return np.array(
        [
            reference_match(live, node).right_inliers(world_from_live.inverse() @ world_from_node)
            for (world_from_node, node), (world_from_live, live) in zip(
                node_frames, live_frames, strict=True
            )
        ],
        dtype=np.int64,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Appearance:
    """How well the morning's map localises the other visits of a town.

    Attributes:
        corners: (P,) corners of the morning's frames.
        inliers: by the name of a visit, (P,) each.
    """

    corners: NDArray[np.int64]
    inliers: Mapping[str, NDArray[np.int64]]

    @staticmethod
    def pooled(towns: Sequence[Appearance]) -> Appearance:
        """All places of some towns as those of one."""
        return Appearance(
            np.concatenate([town.corners for town in towns]),
            {
                name: np.concatenate([town.inliers[name] for town in towns])
                for name in towns[0].inliers
            },
        )


def appearance(
    places: Places, visits: Sequence[str] = tuple(VISITS), monitor: Monitor = QUIET
) -> Appearance:
    """Matches the morning at all places against every other visit.

    The map is made at the places, live stands half a metre from them: 0.35 m ahead and as much to
    the left.

    Args:
        places: of a town; about 90 s on one core for 27 of them.
        visits: that are compared; all of them for the table.
        monitor: hears of each visit that is done.
    """
    morning = reference_frames(places, VISITS[MAPPED])
    inliers: dict[str, NDArray[np.int64]] = {}
    for name in visits:
        if name != MAPPED:
            inliers[name] = inliers_of(morning, reference_frames(places, VISITS[name], 0.35, 0.35))
        monitor.advance(name)
    return Appearance(np.array([frame.corners for _, frame in morning]), inliers)


def appearance_table(seen: Appearance) -> list[Row]:
    """Rows (a) to (c)."""
    same = float(seen.inliers["next morning"].mean())
    later = float(seen.inliers["an hour later"].mean())
    rows = [
        Row("a", "corners a frame", float(seen.corners.mean()), 450, 750, ""),
        Row("a", "same hour, next day", same, 100, np.inf, "inliers"),
        Row("b", "an hour later", 100 * later / max(same, 1), 60, 85, "% of (a)"),
    ]
    for other, high, low in (
        ("late afternoon", 20, 0),
        ("night", 10, 0),
        ("snow", 20, 0),
        ("overcast", 50, 20),
    ):
        share = 100 * float((seen.inliers[other] >= SUCCESS_INLIERS).mean())
        rows.append(Row("c", f"{MAPPED} map, {other}", share, low, high, "% succeed"))
    return rows


def falloff(
    pairs: Sequence[tuple[SE3, StereoPair]], steps: Sequence[int], every: int = 2
) -> dict[int, float]:
    """Mean inliers between a frame and the one some frames further on, along one drive.

    Args:
        pairs: true poses and images, in the order of driving.
        steps: how many frames further on.
        every: only every so many frames are taken as the first of two.
    """
    frames = [(pose, reference_frame(pair)) for pose, pair in pairs]
    return {
        step: float(inliers_of(frames[: len(frames) - step : every], frames[step::every]).mean())
        for step in steps
    }


def falloff_table(town: Mapping[int, float], clip: Mapping[int, float]) -> list[Row]:
    """Rows (e): inliers in the town ÷ those on the clip, by the distance ahead.

    Args:
        town: of `falloff`, with KITTI's camera at the clip's spacing.
        clip: the same on frames of KITTI 06.
    """
    return [
        Row("e", f"{step * CLIP_SPACING_M:.1f} m ahead", town[step] / count, 1 / 1.5, 1.5, "× clip")
        for step, count in clip.items()
    ]
