"""Whether a wrong focal length or baseline shows when a robot localises in a map.

    python -m engram_lab.checks.calibration_by_map                       # held-out towns
    python -m engram_lab.checks.calibration_by_map --towns 301,302 --json scales.json

Every drive of a small town is localised in each map that it is no part of, from a true start: once
as it is, and once with each fault, too long or too short by a share drawn log-uniformly. The fault
is in the calibration that the robot is given; images and maps are right. Told is what the doctor
warns of in the first 200 frames; where there are too few fixes, or too vague ones, it cannot tell.
"""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from engram.frontend.frame import BRIEF, DescriptorKind
from engram.geometry.cameras import StereoCamera
from engram.monitor import QUIET
from engram.odometry.odometry import Odometry
from engram.robot.front import Front
from engram.robot.localisers import localiser_in
from engram.robot.robot import Robot
from engram.robot.settings import Settings
from engram.sequences.sequence import LoggedFrame
from engram_lab.misplaced import Street
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.trial_towns import HELD_OUT_TOWNS, all_streets, light_of

LEAST, MOST = 0.08, 0.3
_HEALTHY, _FOCAL, _BASELINE = "as it is", "focal length", "baseline"
_CODES = {_FOCAL: "focal_length_off", _BASELINE: "baseline_off"}


@dataclass(frozen=True, slots=True)
class Judged:
    """One drive in one map.

    Attributes:
        weather: and whether it was by day.
        fault: what is wrong.
        by: the factor by which it is.
        told: factor of what is wrong, by the map; None if it cannot tell.
        alarm: whether the doctor warns of this fault; of a drive as it is, of any.
        fixes, false: fixes in the examined frames, and those that are false.
    """

    weather: str
    fault: str
    by: float
    told: float | None
    alarm: bool
    fixes: int
    false: int


def miscalibrated(camera: StereoCamera, fault: str, by: float) -> StereoCamera:
    """The camera as a robot takes it to be."""
    if fault == _FOCAL:
        return replace(camera, fx=camera.fx * by, fy=camera.fy * by)
    return replace(camera, baseline_m=camera.baseline_m * (by if fault == _BASELINE else 1.0))


def frames_by(street: Street, camera: StereoCamera, settings: Settings) -> Iterator[LoggedFrame]:
    """The frames that the doctor examines, with another calibration and its own odometry."""
    odometry = Odometry(settings.odometry)
    for one in street.frames[: settings.doctor.frames]:
        frame = replace(one.frame, camera=camera)
        yield LoggedFrame(frame, odometry.step(frame))


def judged(street: Street, weather: str, fault: str, by: float, settings: Settings) -> Judged:
    """Drives once, from a given position."""
    camera = miscalibrated(street.frames[0].frame.camera, fault, by)
    localiser = localiser_in(street.opened, camera, settings, live=street.live.session.id)
    front, fixes, false = Front(settings), 0, 0
    with Robot(front, localiser) as robot:
        start = street.nodes.start(street.truth[0])
        if start is not None:
            robot.place_at(start)
        for number, logged in enumerate(frames_by(street, camera, settings)):
            found = robot.step(logged)
            if found.node is not None and found.node_from_live is not None:
                fixes += 1
                false += street.is_false(number, found.node, found.node_from_live) is True
        codes = {one.code for one in robot.diagnosis.findings}
    rematched = front.examination.evidence.rematched
    told = rematched.baseline_factor if fault == _BASELINE else rematched.focal_factor
    alarm = bool(codes & {_CODES[fault]} if fault in _CODES else codes & set(_CODES.values()))
    return Judged(weather, fault, by, told, alarm, fixes, false)


def all_judged(towns: Sequence[int], settings: Settings) -> Iterator[Judged]:
    """All drives of some towns, with each fault."""
    for plan, name, street in all_streets(towns, settings, 8, QUIET):
        for fault in (_HEALTHY, _FOCAL, _BASELINE):
            rng = np.random.default_rng(zlib.crc32(f"{name} {fault}".encode()))
            share = float(np.exp(rng.uniform(np.log(LEAST), np.log(MOST))))
            by = 1.0 if fault == _HEALTHY else float((1 + share) ** rng.choice([-1, 1]))
            one = judged(street, light_of(plan), fault, by, settings)
            told = "cannot tell" if one.told is None else f"by the map {one.told:.3f}"
            print(
                f"{name} {one.weather}, {fault} × {by:.3f}: {told}, "
                f"{one.fixes} fixes, {one.false} false",
                flush=True,
            )
            yield one
        street.close()


def figures(rows: Sequence[Judged]) -> Iterator[Figure]:
    """By fault, and by weather."""
    by_kind: dict[str, list[Judged]] = defaultdict(list)
    for row in rows:
        by_kind[row.fault].append(row)
        by_kind[f"{row.fault}, {row.weather}"].append(row)
    for kind, some in by_kind.items():
        told = [row for row in some if row.told is not None]
        yield Figure(f"{kind}: warned of {len(some)}", sum(row.alarm for row in some))
        yield Figure("  cannot tell", len(some) - len(told))
        errors = [abs(row.told / row.by - 1) for row in told if row.told is not None]
        if errors:
            yield Figure("  error of the factor, median", 100 * float(np.median(errors)), "%")
        yield Figure("  fixes", sum(row.fixes for row in some))
        yield Figure("  false", sum(row.false for row in some))


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--kind", type=DescriptorKind, default=BRIEF, help="of features")
    parser.add_argument("--towns", type=numbers, default=list(HELD_OUT_TOWNS))
    asked = parser.parse_args()
    settings = Settings().for_descriptor(asked.kind)
    report(figures(list(all_judged(asked.towns, settings))), asked.json, "calibration by the map")


if __name__ == "__main__":
    main()
