"""Relocates a robot behind a gap of its odometry.

Odometry may fail for a second or two, in a bend or in rain, and the nodes behind such a gap are
not connected to those before it. The robot's speed predicts its position behind the gap well enough
to match there, as a live robot does, before place recognition searches the whole map.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from engram.fleet.merge.segments import Segment
from engram.localiser import Localisation, Position
from engram.localiser.attempts import Outcome
from engram.odometry import GapConfig, GapFiller, OdometryStatus, OdometryStep
from engram.robot import Robot
from engram.sequences import LoggedFrame

# Longest gap for a guess. Source: method §3.4, the distance after which a robot is lost.
_GUESS_WITHIN_M = 10.0
# Longest part of a segment that is searched. Source: the distance after which own nodes are
# neighbours again (method §3.1).
_LOOK_WITHIN_M = 30.0
# Least distance of two agreeing matches that relocate a robot (`Hypotheses`).
_BASE_LINE_M = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Ahead:
    """A node of a segment that was localised ahead of its turn.

    Attributes:
        found: its localisation.
        outcomes: outcomes of its attempts.
    """

    found: Localisation
    outcomes: list[Outcome]


def position_behind_gap(
    end: Position, before: Segment, segment: Segment, config: GapConfig
) -> Position | None:
    """Predicts the start of a segment from the robot's speed before the gap.

    Args:
        end: position of the last node of the segment before.
        before: the segment before, of the same session.
        segment: the one behind the gap.
        config: how far a guess is trusted.

    Returns:
        The guess with its covariance (`GapFiller`); None if the speed is unknown, or if the robot
            would have driven more than 10 m.
    """
    gaps = GapFiller(config)
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
    """Tries to localise the first frames of a segment from a guess of its start.

    Args:
        robot: placed at the guess; it tries nowhere else.
        frames: of the segment, in the order of time.

    Returns:
        The first of two matched frames at least 4 m apart, or None; and the number of attempts.
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
