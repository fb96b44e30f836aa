"""Whether odometry weighs evidence: weak steps, exposure that oscillates, wheels right and wrong.

    python -m engram_lab.checks.weighing                       # held-out towns, and real clips
    python -m engram_lab.checks.weighing --towns 401 --json weighing.json

- Weak runs: strong steps of 1 m (500 inliers) with runs of weak ones (100) of another length; how
  many strong ones are replaced by guesses, and the way counted for the true one.
- Oscillating exposure: the real clips that `ENGRAM_DATA` names, one way, with gains of 0.3 to 2.5
  and sides 14 to 25 % apart, localised in a map of undisturbed frames, and mapped.
- What cameras cannot tell: the same clips with a picture that is frozen or partly fixed to the
  camera, with wheels of 2 % slip and a gyroscope.
- Wheels: every drive of the towns, without wheels and with them, right and wrong in six ways.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.maps.map import open_map
from engram.odometry.motion import GapFiller, Motion
from engram.odometry.outside import OutsideMotion
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.front import Front
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram_lab.misplaced import FALSE_M, FALSE_RAD, Kind, Street, Try
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.studies.building import edge_errors
from engram_lab.studies.faults.clips import Clip, ClipDrive
from engram_lab.studies.faults.injected import brightened, with_car
from engram_lab.studies.faults.staging import Place, mapped_by
from engram_lab.studies.faults.study import DRIVES, real_plans
from engram_lab.trial_towns import HELD_OUT_TOWNS, all_streets, light_of
from engram_lab.wheels import Wheels, measured

STRONG, WEAK = 500, 100
STEP_M, WEAK_M = 1.0, 3.6
GAINS, APART = (0.3, 2.5), (0.14, 0.25)
PERIODS = (2, 4, 7, 12)
# An edge, and a step of odometry, further off are wrong.
WRONG_EDGE_M, WRONG_STEP_M = 1.0, 0.3


def weak_runs() -> Iterator[Figure]:
    """Runs of weak steps before, between and after strong ones."""
    strong, weak = _step(STEP_M, STRONG), _step(WEAK_M, WEAK)
    still, slow = _step(0.0, WEAK), _step(0.4 * STEP_M, WEAK)
    runs = {
        "3 weak steps, then 117 strong": [weak] * 3 + [strong] * 117,
        "20 weak steps, then 100 strong": [weak] * 20 + [strong] * 100,
        "3 weak ones among strong": [strong] * 40 + [weak] * 3 + [strong] * 77,
        "20 that stand still among strong": [strong] * 40 + [still] * 20 + [strong] * 60,
        "10 slow ones among strong": [strong] * 40 + [slow] * 10 + [strong] * 70,
        "2 weak, 3 strong, 24 times": ([weak] * 2 + [strong] * 3) * 24,
    }
    for name, steps in runs.items():
        gaps = GapFiller()
        gaps.motion(OdometryStep(OdometryStatus.FIRST), 0)
        motions = [gaps.motion(one, at * 10**8) for at, one in enumerate(steps, 1)]
        replaced = sum(one.guessed_m > 0 and one.odometry is strong for one in motions)
        yield Figure(f"{name}: strong ones replaced", replaced)
        yield Figure(f"  way counted for {STEP_M * len(steps):.0f} m", _way_m(motions), "m")


def _step(metres: float, inliers: int) -> OdometryStep:
    pose = SE3(np.eye(3), np.array([0.0, 0.0, metres]))
    return OdometryStep(OdometryStatus.OK, pose, 1e-6 * np.eye(6), inliers)


def _way_m(motions: Sequence[Motion]) -> float:
    return sum(one.moved_m for one in motions)


def oscillating(pairs: Sequence[StereoPair], period: int, seed: int) -> list[StereoPair]:
    """The pairs under an exposure that oscillates, one side always brighter than the other.

    Args:
        pairs: of a drive.
        period: frames of one oscillation.
        seed: of by how much the sides differ.
    """
    rng = np.random.default_rng(seed)
    low, high = np.log(GAINS)
    gains = np.exp(
        low + (high - low) * (0.5 + 0.5 * np.cos(2 * np.pi * np.arange(len(pairs)) / period))
    )
    apart = 1 + rng.choice([-1, 1]) * rng.uniform(*APART, len(pairs))
    return [
        replace(
            pair,
            left=brightened(pair.left, gain),
            right=brightened(pair.right, gain * side),
        )
        for pair, gain, side in zip(pairs, gains.tolist(), apart.tolist(), strict=True)
    ]


def real_clips() -> Iterator[tuple[Place, Clip]]:
    """Each real clip with the map of its place."""
    plans = real_plans()
    for town in DRIVES:
        clips = [one for one in plans if one.town == town]
        if not clips:
            continue
        with tempfile.TemporaryDirectory(prefix="engram-weighing-") as folder:
            mapped = next(one for one in clips if one.mapped)
            place = mapped_by(mapped.read(), Path(folder) / "own.engram")
            for plan in clips:
                if not plan.mapped:
                    yield place, plan.read()
            place.opened.close()


def exposure(place: Place, clip: Clip) -> Iterator[Figure]:
    """Fixes and edges of a real clip under an exposure that oscillates."""
    one_way = clip.pairs[: len(clip.pairs) // 2 + 1]
    for period in PERIODS:
        shown = oscillating(one_way, period, seed=period)
        right, false = fixes(place, clip, shown)
        off_m = edges_off_m(clip, shown)
        yield Figure(f"{clip.plan.name}, period {period}: right fixes of {len(shown)}", right)
        yield Figure("  false fixes", false)
        yield Figure(f"  edges > 1 m wrong, of {len(off_m)}", sum(m > WRONG_EDGE_M for m in off_m))


def fixes(
    place: Place,
    clip: Clip,
    shown: Sequence[StereoPair],
    outside: Sequence[OutsideMotion | None] | None = None,
) -> tuple[int, int]:
    """Right and false fixes of a robot that is shown something else than the clip.

    Args:
        place: the map.
        clip: the truth.
        shown: what it is shown.
        outside: of its wheels; None without.
    """
    right = false = 0
    with place.opened.robot(clip.pairs[0].camera) as robot:
        for number, pair in enumerate(shown):
            found = robot.step(pair, motion=outside[number] if outside else None)
            error = place.error(found, clip.world_from_cam[number])
            if error is not None:
                wrong = error[0] > FALSE_M or error[1] > FALSE_RAD
                right, false = right + (not wrong), false + wrong
    return right, false


def edges_off_m(clip: Clip, shown: Sequence[StereoPair]) -> list[float]:
    """How wrong each edge is that a robot lays which maps what it is shown."""
    truth = {pair.stamp_ns: pose for pair, pose in zip(shown, clip.world_from_cam, strict=False)}
    with tempfile.TemporaryDirectory(prefix="engram-weighing-") as folder:
        path = Path(folder) / "drive.engram"
        drive = ClipDrive(clip.plan, list(shown))
        map_drive(path, drive, Settings(), RobotOptions(force=True))
        with open_map(path) as opened:
            poses = {one.id: truth[one.stamp_ns] for one in opened.graph.nodes}
            return [one.error_m for one in edge_errors(opened.graph.edges, poses.get)]


def unseen(place: Place, clip: Clip) -> Iterator[Figure]:
    """Fixes where cameras see that the robot stands and wheels that it does not."""
    pairs, stamps = clip.pairs, [one.stamp_ns for one in clip.pairs]
    wheels, half = measured(clip.world_from_cam, stamps, 1), len(pairs) // 2
    rng = np.random.default_rng(1)

    def frozen(first: int) -> list[StereoPair]:
        old = pairs[first]
        return [
            replace(one, left=old.left, right=old.right) if at > first else one
            for at, one in enumerate(pairs)
        ]

    shown = {
        "undisturbed": list(pairs),
        "frozen from the start": frozen(0),
        "frozen half-way": frozen(half),
        "a tenth fixed to the camera": [with_car(one, 0.1, rng) for one in pairs],
        "a third fixed to the camera": [with_car(one, 0.33, rng) for one in pairs],
        "most of it fixed to the camera": [with_car(one, 0.6, rng) for one in pairs],
    }
    for name, some in shown.items():
        for outside in (None, wheels):
            right, false = fixes(place, clip, some, outside)
            how = "with wheels" if outside else "cameras alone"
            yield Figure(f"{clip.plan.name}, {name}, {how}: right fixes", right)
            yield Figure("  false fixes", false)


@dataclass(slots=True)
class Driven:
    """What one kind of wheels came to in one weather.

    Attributes:
        steps, wrong: of odometry, and those that are more than 0.3 m off.
        frames, right, false: of the drives, and fixes there.
    """

    steps: int = 0
    wrong: int = 0
    frames: int = 0
    right: int = 0
    false: int = 0


def add(driven: Driven, street: Street, outside: Sequence[OutsideMotion | None] | None) -> None:
    """One drive in one map."""
    front, last = Front(street.settings), 0
    for number, logged in enumerate(street.frames):
        _, motion = front.take(logged, outside[number] if outside else None)
        if not motion.usable:
            continue
        if motion.prev_from_curr is not None and number:
            true = street.truth[last].inverse() @ street.truth[number]
            driven.steps += 1
            driven.wrong += (motion.prev_from_curr.inverse() @ true).distance_m > WRONG_STEP_M
        last = number
    for looked in street.run(Try(Kind.UNDISTURBED, 0), outside=outside):
        found = looked.found
        driven.frames += 1
        if found.node is not None and found.node_from_live is not None:
            wrong = street.is_false(looked.frame, found.node, found.node_from_live)
            driven.right += wrong is False
            driven.false += wrong is True


def with_wheels(towns: Sequence[int]) -> Iterator[Figure]:
    """All drives of some towns in all their maps, by weather and by wheels."""
    found: dict[tuple[str, str], Driven] = {}
    for plan, _, street in all_streets(towns, Settings(), 8):
        stamps = [one.frame.stamp_ns for one in street.frames]
        for wheels in (None, *Wheels):
            outside = None if wheels is None else measured(street.truth, stamps, 1, wheels)
            key = light_of(plan), "no wheels" if wheels is None else wheels.value
            add(found.setdefault(key, Driven()), street, outside)
        street.close()
    for (weather, wheels), one in sorted(found.items()):
        yield Figure(f"{weather}, {wheels}: steps > 0.3 m off", 100 * one.wrong / one.steps, "%")
        yield Figure("  right fixes", 100 * one.right / one.frames, "%")
        yield Figure("  false fixes", one.false)


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--towns", type=numbers, default=list(HELD_OUT_TOWNS))
    parser.add_argument("--only", choices=("weak", "real", "towns"), help="one part")
    asked = parser.parse_args()
    if asked.only in {None, "weak"}:
        report(weak_runs(), asked.json, "weak runs")
    if asked.only in {None, "real"}:
        for place, clip in real_clips():
            report(exposure(place, clip), asked.json, f"oscillating exposure, {clip.plan.name}")
            report(unseen(place, clip), asked.json, f"what cameras cannot tell, {clip.plan.name}")
    if asked.only in {None, "towns"}:
        report(with_wheels(asked.towns), asked.json, "wheels")


if __name__ == "__main__":
    main()
