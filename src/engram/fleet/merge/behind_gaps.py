"""Finding a robot again where its own map falls apart.

Odometry loses track in a bend, in the rain, for a second or two, and what the robot saved behind
such a gap hangs together with nothing before it. How it drove tells about where it was a second
later: near enough to look for it there, as a live robot does, before all places are asked.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from engram.fleet.merge.segments import Segment
from engram.localiser import Localisation, Position
from engram.localiser.attempts import Outcome
from engram.odometry import GapFiller, OdometryStatus, OdometryStep
from engram.robot import Robot
from engram.sequences import LoggedFrame

# A guess over a longer way is none. Source: SPEC §3.4, after which a robot counts as lost.
_GUESS_WITHIN_M = 10.0
# So far along a segment it is looked for. Source: the distance after which own nodes are
# neighbours again (SPEC §3.1).
_LOOK_WITHIN_M = 30.0
# Two matches that agree find a lost robot when they are so far apart (`Hypotheses`).
_BASE_LINE_M = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Ahead:
    """A node of a segment that was localised before its turn came.

    Attributes:
        found: what was found of it.
        outcomes: of the attempts for it.
    """

    found: Localisation
    outcomes: list[Outcome]


def position_behind_gap(end: Position, before: Segment, segment: Segment) -> Position | None:
    """Where a segment begins if the robot drove on as it did.

    Args:
        end: position of the last node of the segment before.
        before: the segment before, of the same session.
        segment: the one behind the gap.

    Returns:
        The guess with its covariance (`GapFiller`); None where the speed is not known, or where
        the robot would have driven more than 10 m.
    """
    gaps = GapFiller()
    gaps.motion(OdometryStep(OdometryStatus.FIRST), before.nodes[0].stamp_ns)
    for node, motion in zip(before.nodes[1:], before.motions, strict=True):
        gaps.motion(OdometryStep(OdometryStatus.OK, *motion), node.stamp_ns)
    lost = OdometryStep(OdometryStatus.NO_CONSENSUS)
    guess = gaps.motion(lost, segment.nodes[0].stamp_ns)
    assert guess.prev_from_curr is not None
    assert guess.covariance is not None
    if guess.guessed_m > _GUESS_WITHIN_M or guess.moved_m > _GUESS_WITHIN_M:
        return None
    return end.carried_on(guess.prev_from_curr, guess.covariance)


def look_along(robot: Robot, frames: Iterable[LoggedFrame]) -> tuple[Ahead | None, int]:
    """Looks for the first frames of a segment from a guess of where it begins.

    Args:
        robot: placed where the first frame is thought to be; it looks nowhere else.
        frames: of the segment, in the order of time.

    Returns:
        The first of two frames at least 4 m apart that are matched; None where there are no two.
        And how many attempts that took.
    """
    first: Ahead | None = None
    driven_m = first_at_m = 0.0
    attempts = 0
    for logged in frames:
        driven_m += logged.odometry.moved_m
        if driven_m > _LOOK_WITHIN_M:
            break
        found = robot.step(logged)
        attempts += found.attempts
        if not found.localised:
            continue
        if first is None:
            assert robot.last is not None
            first, first_at_m = Ahead(found, robot.last.outcomes), driven_m
        elif driven_m - first_at_m >= _BASE_LINE_M:
            return first, attempts
    return None, attempts
