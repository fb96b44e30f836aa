"""The maps of the study, with the true poses of their nodes."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engram.geometry import SE3
from engram.graph.model import NodeId
from engram.localiser import Localisation, Position
from engram.maps import Map, open_map
from engram_lab.studies.faults.clips import Clip, Plan

# A place is wrong that is so far off, m.
_OFF_M = 15.0
# Another town lies so far away that no place there is right by chance.
_OTHER_TOWN = SE3(np.eye(3), np.array([1e4, 0.0, 0.0]))


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A town that is mapped by its first clip.

    Attributes:
        path: the map, NAME.engram.
        opened: the same, opened.
        world_from_node: true poses of its nodes.
    """

    path: Path
    opened: Map
    world_from_node: dict[NodeId, SE3]

    def error(self, found: Localisation, world_from_cam: SE3) -> tuple[float, float] | None:
        """How far off a fix is, metres and radians; None without one."""
        if found.node is None or found.node_from_live is None:
            return None
        node_from_live = self.world_from_node[found.node].inverse() @ world_from_cam
        wrong = node_from_live.inverse() @ found.node_from_live
        return wrong.distance_m, wrong.angle_rad

    def wrong_hint(
        self, world_from_cam: SE3, sigma_m: float, rng: np.random.Generator
    ) -> Position | None:
        """A wrong place for a camera, with a standard deviation; None if all are near."""
        far = [
            node
            for node, pose in self.world_from_node.items()
            if (world_from_cam.inverse() @ pose).distance_m >= _OFF_M
        ]
        if not far:
            return None
        covariance = np.diag([sigma_m**2] * 3 + [np.deg2rad(2.0) ** 2] * 3)
        return Position(far[int(rng.integers(len(far)))], SE3.identity(), covariance)


def mapped_by(clip: Clip, path: Path, world_from_town: SE3 | None = None) -> Place:
    """The place that a robot made that mapped a clip live.

    Args:
        clip: what it saw.
        path: the map; must not exist yet.
        world_from_town: where the town of the clip lies; None for the origin.
    """
    with (
        open_map(path, create=True) as opened,
        opened.robot(clip.pairs[0].camera, name="mapper", maps=True) as robot,
    ):
        for pair in clip.pairs:
            robot.step(pair)
    world_from_town = world_from_town or SE3.identity()
    truth = {
        pair.stamp_ns: world_from_town @ pose
        for pair, pose in zip(clip.pairs, clip.world_from_cam, strict=True)
    }
    found = open_map(path)
    return Place(path, found, {node.id: truth[node.stamp_ns] for node in found.graph.nodes})


def damaged(place: Place, path: Path, share: float, rng: np.random.Generator) -> Place:
    """A copy of a place in which the landmarks of some nodes, at least one, cannot be read.

    Args:
        place: the sound one.
        path: the copy; replaced if it is there.
        share: of the nodes.
        rng: chooses them, and what happened to them.
    """
    shutil.copyfile(place.path, path)
    with closing(sqlite3.connect(path)) as connection, connection:
        rows = connection.execute("SELECT node, landmarks FROM frames ORDER BY node").fetchall()
        for row in rng.permutation(len(rows))[: max(1, round(share * len(rows)))]:
            node, landmarks = rows[row]
            connection.execute(
                "UPDATE frames SET landmarks = ? WHERE node = ?", (_spoilt(landmarks, rng), node)
            )
    return Place(path, open_map(path), place.world_from_node)


def _spoilt(landmarks: bytes, rng: np.random.Generator) -> bytes:
    """One byte changed, cut short, or nothing left."""
    at, how = int(rng.integers(len(landmarks))), int(rng.integers(3))
    if how == 0:
        return landmarks[:at] + bytes([landmarks[at] ^ 0x10]) + landmarks[at + 1 :]
    return landmarks[:at] if how == 1 else b""


class Places:
    """The maps of one town; the clips that are driven there.

    Args:
        plans: all clips.
        town: which town.
        folder: for the maps; must be empty.

    Attributes:
        folder: the same.
        own: the town's map; None if the clip for it is missing.
        other: that of another town, if possible by the same kind of camera; None without one.
    """

    def __init__(self, plans: Sequence[Plan], town: int | str, folder: Path) -> None:
        self.folder = folder
        maps = [plan for plan in plans if plan.mapped]
        own = next((plan for plan in maps if plan.town == town), None)
        others = [plan for plan in maps if plan.town != town]
        self.own = mapped_by(own.read(), folder / "own.engram") if own else None
        self.other: Place | None = None
        if own and others:
            nearest = min(others, key=lambda plan: plan.rig != own.rig)
            self.other = mapped_by(nearest.read(), folder / "other.engram", _OTHER_TOWN)
        self._damaged: Place | None = None
        self._clip: Clip | None = None

    def clip(self, plan: Plan) -> Clip:
        """A clip; the last one is kept."""
        if self._clip is None or self._clip.plan != plan:
            self._clip = plan.read()
        return self._clip

    def damaged(self, share: float, rng: np.random.Generator) -> Place | None:
        """The town's map with damaged landmarks, until the next one is requested."""
        self._close(self._damaged)
        path = self.folder / "damaged.engram"
        self._damaged = damaged(self.own, path, share, rng) if self.own else None
        return self._damaged

    def close(self) -> None:
        """Closes the maps."""
        for place in (self.own, self.other, self._damaged):
            self._close(place)

    def _close(self, place: Place | None) -> None:
        if place is not None:
            place.opened.close()
