"""What a localised drive comes to: one result per frame, and a summary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from engram.geometry import SE3
from engram.localiser import Localisation, LocalisationStatus
from engram.measures import Drive, failure_route, longest_gap_m, route_m, route_not_localised
from engram.odometry.motion import driven_steps_m


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """One live frame of a drive.

    Attributes:
        localisation: the localiser's answer.
        prev_from_curr: odometry since the frame before; None for the first frame and failures.
        stage_ms: time of each stage, front-end to remembering.
        late: in a replay in real time, whether the answer came after the deadline; else False.
    """

    localisation: Localisation
    prev_from_curr: SE3 | None
    stage_ms: dict[str, float]
    late: bool = False

    @property
    def ms(self) -> float:
        """Time of all stages together."""
        return sum(self.stage_ms.values())

    @property
    def localised(self) -> bool:
        """Whether the frame was matched with the map."""
        return self.localisation.status is LocalisationStatus.LOCALISED

    def to_dict(self) -> dict[str, Any]:
        """The record that ``localise --json`` prints for this frame."""
        found = self.localisation
        return {
            "stamp_ns": found.stamp_ns,
            "status": found.status.value,
            "node": None if found.node is None else str(found.node),
            "node_stamp_ns": found.node_stamp_ns,
            "node_from_live": None
            if found.node_from_live is None
            else found.node_from_live.matrix().ravel().tolist(),
            "inliers": found.inliers,
            "attempts": found.attempts,
            "candidates": found.candidates,
            "open_loop_m": found.open_loop_m,
            "damaged": [str(node) for node in found.damaged],
            "ms": self.ms,
        }


def measured(found: Sequence[Localisation]) -> Drive:
    """What the measures need of a drive's localisations.

    Steps that odometry could not measure are guessed, and those past frames of no use are shared
    among them: without these the worst stretches of a drive would count as nothing.
    """
    steps_m = driven_steps_m([one.motion for one in found], [one.stamp_ns for one in found])
    localised = [one.status is LocalisationStatus.LOCALISED for one in found]
    return Drive(steps_m, np.array(localised, np.bool_))


def summarise(results: Sequence[FrameResult]) -> dict[str, Any]:
    """The summary that ``localise --json`` prints; every figure is defined in SPEC §8."""
    drive = measured([result.localisation for result in results])
    count = max(len(results), 1)
    statuses = [result.localisation.status for result in results]
    return {
        "frames": len(results),
        "share_localised": sum(result.localised for result in results) / count,
        "statuses": {status.value: statuses.count(status) for status in LocalisationStatus},
        "attempts_per_frame": sum(r.localisation.attempts for r in results) / count,
        "driven_m": route_m([drive]),
        "p_no_match_10m": failure_route([drive], 10.0),
        "route_not_localised": route_not_localised([drive]),
        "longest_gap_m": longest_gap_m([drive]),
        "late_frames": sum(result.late for result in results),
        "damaged_nodes": sorted({str(n) for r in results for n in r.localisation.damaged}),
        "stages_ms": stage_statistics([result.stage_ms for result in results]),
    }


def damage_warning(damaged: Sequence[str]) -> str:
    """What people are told of the nodes that could not be read; needs at least one."""
    return (
        f"warning: {len(damaged)} damaged nodes of the map were passed over, such as "
        f"{damaged[0]}: engram check tells more"
    )


def stage_statistics(stage_ms: Sequence[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Median and 99th percentile of each stage and of their sum, ms."""
    stages = dict.fromkeys(stage for frame in stage_ms for stage in frame)
    series = {stage: [frame.get(stage, 0.0) for frame in stage_ms] for stage in stages}
    if series:
        series["total"] = [sum(frame.values()) for frame in stage_ms]
    return {
        stage: {
            "median": float(np.median(values)),
            "p99": float(np.percentile(values, 99)),
        }
        for stage, values in series.items()
    }
