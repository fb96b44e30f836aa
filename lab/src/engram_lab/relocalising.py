"""Every frame of a drive as a cold start: which places look like it, and which one it was."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from engram.frontend import Frame, FrameStatus
from engram.graph.model import NodeId, node_id
from engram.localiser import UNNAMED_LIVE_SESSION, Budget, FrameMatcher, Relocaliser
from engram.localiser.attempts import Attempter, Candidate, best_success
from engram.maps import Map, open_map
from engram.monitor import QUIET, Monitor
from engram.robot.live import live_frames
from engram.robot.localisers import relocaliser_in
from engram.robot.session import DriveSequence
from engram.robot.settings import Settings


class PlaceStatus(StrEnum):
    """What a cold start came to."""

    FOUND = "found"
    NEW_PLACE = "new_place"
    UNKNOWN = "unknown"
    UNUSABLE_FRAME = "unusable_frame"


@dataclass(frozen=True, slots=True)
class ColdStart:
    """One frame that knew nothing of the frames before it.

    Attributes:
        stamp_ns: of the frame.
        status: found by matching; or not found; or certainly new, since the map holds no place at
            all; or the frame was of no use.
        node: the node that it was matched with; None unless found.
        inliers: of that match; 0 unless found.
        attempts: match attempts made.
        new_place: probability of a new place before matching; None where the relocaliser cannot
            tell. Not to be relied on.
        damaged: nodes that were to be attempted and whose landmarks cannot be read.
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
    at: int | str | None = None,
    monitor: Monitor = QUIET,
) -> list[ColdStart]:
    """Finds every frame of a drive in a map as if the robot had just been switched on.

    Args:
        map_path: the map, which stays as it is.
        sequence: the drive.
        settings: the resolved configuration.
        relocaliser: key of `RELOCALISERS`.
        budget: of each frame: that of a lost robot.
        at: number or tag of the map's revision; None for the newest.
        monitor: hears of each frame, with its status.

    Raises:
        ConfigError: there is no such relocaliser.
        MapError: the map cannot be read.
    """
    budget = budget or Budget()
    with open_map(map_path, at) as opened:
        settings = settings.for_descriptor(opened.descriptor)
        finder = relocaliser_in(opened, relocaliser, settings.frontend.descriptor)
        matcher = FrameMatcher(opened.frames, settings.localiser.lost_matcher)
        with (
            Attempter(matcher, matcher, budget.lanes, settings.localiser.acceptance) as attempter,
            closing(live_frames(sequence, settings)) as frames,
            monitor.stage("relocalise", len(sequence)) as part,
        ):
            found = []
            for live in frames:
                finder.forget()
                found.append(_cold_start(opened, live.frame, finder, attempter, budget))
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


def _cold_start(
    opened: Map, frame: Frame, finder: Relocaliser, attempter: Attempter, budget: Budget
) -> ColdStart:
    if frame.status is not FrameStatus.OK:
        return ColdStart(frame.stamp_ns, PlaceStatus.UNUSABLE_FRAME, None, 0, 0, None)
    proposed = finder.propose(frame, budget.lost_attempts, lambda _: True)
    candidates = [
        Candidate(index, opened.graph.node(index).id, None, guided=False, row=None)
        for index in proposed
    ]
    live_id = node_id(UNNAMED_LIVE_SESSION, frame.stamp_ns)
    outcomes = attempter.run(frame, live_id, candidates, None)
    damaged = tuple(outcome.candidate.node for outcome in outcomes if outcome.damaged)
    success = best_success(outcomes)
    if success is None:
        # Where nothing can be tried all is new. Elsewhere the probability does not decide: under
        # another light it cannot tell known places from new ones (docs/places.md).
        status = PlaceStatus.UNKNOWN if proposed else PlaceStatus.NEW_PLACE
        return ColdStart(frame.stamp_ns, status, None, 0, len(outcomes), finder.new_place, damaged)
    return ColdStart(
        frame.stamp_ns,
        PlaceStatus.FOUND,
        success.candidate.node,
        success.match.inliers,
        len(outcomes),
        finder.new_place,
        damaged,
    )
