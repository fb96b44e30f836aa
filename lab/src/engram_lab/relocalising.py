"""Every frame of a drive as a cold start: which places look like it, and which one it was."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from engram.graph.model import NodeId
from engram.localiser.localisation import Budget, Localisation
from engram.localiser.relocalisation import Relocaliser
from engram.maps.map import open_map
from engram.monitor import QUIET, Monitor
from engram.robot.front import Front, arriving
from engram.robot.localisers import DriveSequence, localiser_in, relocaliser_in
from engram.robot.robot import Robot
from engram.robot.settings import Settings


class PlaceStatus(StrEnum):
    """What a cold start came to."""

    FOUND = "found"
    NEW_PLACE = "new_place"
    UNKNOWN = "unknown"
    UNUSABLE_FRAME = "unusable_frame"


@dataclass(frozen=True, slots=True)
class ColdStart:
    """One frame, localised without the frames before it.

    Attributes:
        status: found by matching; or not found; or certainly new, since the map holds no place at
            all; or the frame was of no use.
        node: the node that it was matched with; None unless found.
        inliers: of that match; 0 unless found.
        new_place: probability of a new place before matching; None where the relocaliser cannot
            tell. Not to be relied on.
    """

    stamp_ns: int
    status: PlaceStatus
    node: NodeId | None
    inliers: int
    attempts: int
    new_place: float | None
    damaged: tuple[NodeId, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "stamp_ns": self.stamp_ns,
            "status": self.status.value,
            "node": None if self.node is None else str(self.node),
            "inliers": self.inliers,
            "attempts": self.attempts,
            "new_place": self.new_place,
            "damaged": [str(node) for node in self.damaged],
        }


def relocalise_drive(
    map_path: Path,
    sequence: DriveSequence,
    settings: Settings,
    *,
    relocaliser: str = "fabmap",
    budget: Budget | None = None,
    threads: int | None = None,
    at: int | str | None = None,
    monitor: Monitor = QUIET,
) -> list[ColdStart]:
    """Finds every frame of a drive in a map as if the robot had just been switched on.

    Args:
        threads: most threads that its lanes share; None for one each.
        at: number or tag of the map's revision; None for the newest.
    """
    with open_map(map_path, at) as opened:
        settings = settings.for_descriptor(opened.descriptor)
        finder = relocaliser_in(opened, relocaliser, settings.frontend.descriptor)
        localiser = localiser_in(
            opened,
            sequence.camera,
            settings,
            budget=budget,
            relocaliser=finder,
            threads=threads,
        )
        with (
            Robot(Front(settings), localiser) as robot,
            closing(arriving(sequence)) as frames,
            monitor.stage("relocalise", len(sequence)) as part,
        ):
            found = []
            for arrived in frames:
                robot.lose()
                found.append(_cold_start(robot.step(arrived), finder))
                part.advance(found[-1].status.value)
    return found


def summarise_cold_starts(starts: list[ColdStart]) -> dict[str, Any]:
    """How many frames came to what, and the attempts made."""
    counts = Counter(start.status for start in starts)
    return {
        "frames": len(starts),
        **{status.value: counts[status] for status in PlaceStatus},
        "attempts": sum(start.attempts for start in starts),
        "damaged_nodes": sorted({str(node) for start in starts for node in start.damaged}),
    }


def _cold_start(found: Localisation, finder: Relocaliser) -> ColdStart:
    if not found.motion.usable:
        return ColdStart(found.stamp_ns, PlaceStatus.UNUSABLE_FRAME, None, 0, 0, None)
    # Where nothing can be tried all is new. Elsewhere the probability does not decide: under
    # another light it cannot tell known places from new ones (lab/reports/places.md).
    status = PlaceStatus.UNKNOWN if found.attempts or found.damaged else PlaceStatus.NEW_PLACE
    return ColdStart(
        found.stamp_ns,
        PlaceStatus.FOUND if found.localised else status,
        found.node,
        found.inliers,
        found.attempts,
        finder.new_place,
        found.damaged,
    )
