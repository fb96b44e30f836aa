"""Whether covariances are true: of fixes, of steps of odometry, of 20 m of dead reckoning.

    python -m engram_lab.checks.covariances                    # held-out towns
    python -m engram_lab.checks.covariances --towns 401,402 --json covariances.json

Of each weather: the share of errors within the ellipsoid that should hold 50, 90 and 99 %, of all
six degrees of freedom; fixes are those of undisturbed robots in every map of the town, less than
1 m and 5° off. A step of odometry is wrong that is 0.2 m off, and sharp below 0.1 m of standard
deviation. Motion is what a robot uses: measured steps, and guesses where these fail.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from engram.geometry.se3 import SE3
from engram.graph.model import NodeId, node_id
from engram.localiser.localisation import Position
from engram.monitor import QUIET
from engram.odometry.motion import GapFiller
from engram.robot.settings import Settings
from engram_lab.accuracy import LEVELS, squared
from engram_lab.misplaced import Kind, Street, Try
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.trial_towns import HELD_OUT_TOWNS, all_streets, light_of

WRONG_M, SHARP_M = 0.2, 0.1
RECKONED_M, EVERY = 20.0, 5


@dataclass(slots=True)
class Errors:
    """Squared normalised errors in one weather.

    Attributes:
        fixes, steps, ways: of right fixes, of measured steps, of dead reckoning.
        wrong_sharp: steps that are wrong and claim to be sharp.
        sharp: steps that claim it.
    """

    fixes: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)
    ways: list[float] = field(default_factory=list)
    wrong_sharp: int = 0
    sharp: int = 0


def add_motion(errors: Errors, street: Street) -> None:
    """Steps and ways of the drive."""
    gaps, truth = GapFiller(), street.truth
    last: int | None = None
    ways: list[tuple[int, Position]] = []
    nowhere: NodeId = node_id(street.live.session.id, 0)
    for number, logged in enumerate(street.frames):
        motion = gaps.motion(
            logged.odometry, logged.frame.stamp_ns, landmarks=len(logged.frame.landmarks)
        )
        if not motion.usable:
            continue
        step, covariance = motion.prev_from_curr, motion.covariance
        if step is not None and covariance is not None and last is not None:
            true = truth[last].inverse() @ truth[number]
            if not motion.guessed_m:
                sharp = _sigma_m(covariance) < SHARP_M
                errors.sharp += sharp
                errors.wrong_sharp += sharp and (step.inverse() @ true).distance_m > WRONG_M
                errors.steps.append(squared(step, covariance, true))
            ways = [(start, at.carried_on(step, covariance)) for start, at in ways]
        elif last is not None:
            ways = []
        for start, at in ways:
            true = truth[start].inverse() @ truth[number]
            if true.distance_m >= RECKONED_M:
                errors.ways.append(squared(at.node_from_live, at.covariance, true))
        ways = [
            (start, at)
            for start, at in ways
            if (truth[start].inverse() @ truth[number]).distance_m < RECKONED_M
        ]
        if number % EVERY == 0:
            ways.append((number, Position(nowhere, SE3.identity(), np.zeros((6, 6)))))
        last = number


def add_fixes(errors: Errors, street: Street) -> None:
    """Right fixes of an undisturbed robot."""
    for looked in street.run(Try(Kind.UNDISTURBED, 0)):
        found = looked.found
        if found.node is None or found.node_from_live is None or found.covariance is None:
            continue
        world_from_node = street.nodes.pose(found.node)
        if world_from_node is None or street.is_false(
            looked.frame, found.node, found.node_from_live
        ):
            continue
        true = world_from_node.inverse() @ street.truth[looked.frame]
        errors.fixes.append(squared(found.node_from_live, found.covariance, true))


def _sigma_m(covariance: NDArray[np.float64]) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))


def errors_of(towns: Sequence[int]) -> dict[str, Errors]:
    """All drives of some towns, by weather."""
    found: dict[str, Errors] = defaultdict(Errors)
    driven = set()
    for plan, _, street in all_streets(towns, Settings(), 8, QUIET):
        errors = found[light_of(plan)]
        if street.live.session.id not in driven:
            driven.add(street.live.session.id)
            add_motion(errors, street)
        add_fixes(errors, street)
        street.close()
    return found


def figures(found: dict[str, Errors]) -> Iterator[Figure]:
    """Coverage by weather."""
    for weather, errors in sorted(found.items()):
        kinds = {"fixes": errors.fixes, "steps of odometry": errors.steps}
        kinds[f"{RECKONED_M:.0f} m of dead reckoning"] = errors.ways
        for name, values in kinds.items():
            if not values:
                continue
            yield Figure(f"{weather}: {name}", len(values))
            for level in LEVELS:
                inside = np.array(values) <= chi2.ppf(level, 6)
                yield Figure(f"  within {100 * level:.0f} %", 100 * float(inside.mean()), "%")
        yield Figure(f"{weather}: sharp steps", errors.sharp)
        yield Figure("  wrong ones among them", errors.wrong_sharp)


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--towns", type=numbers, default=list(HELD_OUT_TOWNS))
    asked = parser.parse_args()
    report(figures(errors_of(asked.towns)), asked.json, "coverage of covariances")


if __name__ == "__main__":
    main()
