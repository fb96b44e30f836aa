"""Reasons for the order of one frame's candidates: `engram explain`."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError
from engram.graph.model import Clock, NodeId, SessionId
from engram.localiser.localisation import LocalisationStatus
from engram.maps.map import Map
from engram.ranking.context import Foreseen, RankingContext, RankingPolicy, Reasons, reasons_of
from engram.ranking.policies import policy_named
from engram.robot.front import arriving
from engram.robot.localisers import DriveSequence
from engram.robot.robot import LastFrame
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_on


@dataclass(frozen=True, slots=True)
class ExplainedCandidate:
    """One candidate of the frame.

    Attributes:
        node, session: ids of the node and of its session.
        drive: robot and start of the session, as text.
        distance_m, along_m, across_m, yaw_rad: expected pose of the live camera in the node.
        success_rate: g, probability of a match at that distance if the appearance is compatible.
        chance: probability of success by the policy; None if it estimates none.
        by_turn: whether its place is by rotation, not by its score: a lost robot also tries nodes
            that it does not rank best.
        attempted: whether the budget reached it.
        would_match: whether it matched, or would have.
    """

    node: NodeId
    session: SessionId
    drive: str
    distance_m: float
    along_m: float
    across_m: float
    yaw_rad: float
    success_rate: float
    chance: float | None
    by_turn: bool
    terms: dict[str, float]
    attempted: bool
    would_match: bool
    inliers: int

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {
            "node": str(self.node),
            "session": str(self.session),
            "drive": self.drive,
            "distance_m": self.distance_m,
            "along_m": self.along_m,
            "across_m": self.across_m,
            "yaw_rad": self.yaw_rad,
            "success_rate": self.success_rate,
            "chance": self.chance,
            "by_turn": self.by_turn,
            "terms": {
                name: value if math.isfinite(value) else None for name, value in self.terms.items()
            },
            "attempted": self.attempted,
            "would_match": self.would_match,
            "inliers": self.inliers,
        }


@dataclass(frozen=True, slots=True)
class Explanation:
    """The order of one frame's candidates, with reasons.

    Attributes:
        frame: number of the frame.
        stamp_ns: its stamp, UTC.
        status: localisation status of the frame.
        meaning: description of each term, one line each.
        rule: how the terms give the order; empty if the policy's name says it.
        candidates: best first; empty if the robot had no position or the frame was unusable.
        refused: whether it matched, but is not localised: its run of matches may be one of
            look-alikes (`engram.localiser.yardstick`).
    """

    frame: int
    stamp_ns: int
    ranking: str
    status: LocalisationStatus
    meaning: dict[str, str] = field(default_factory=dict)
    rule: str = ""
    candidates: tuple[ExplainedCandidate, ...] = ()
    refused: bool = False

    def to_dict(self) -> dict[str, Any]:
        """What ``explain --json`` prints."""
        return {
            "frame": self.frame,
            "stamp_ns": self.stamp_ns,
            "ranking": self.ranking,
            "status": self.status.value,
            "meaning": self.meaning,
            "rule": self.rule,
            "refused": self.refused,
            "candidates": [candidate.to_dict() for candidate in self.candidates],
        }


class _Watching:
    """Wraps a policy, and keeps its last context and what would have matched."""

    def __init__(self, policy: RankingPolicy) -> None:
        self._policy = policy
        self.name = policy.name
        self.watches = False
        self.asked: tuple[RankingContext, NDArray[np.int64], Reasons, Foreseen] | None = None

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        order = self._policy.rank(context)
        if self.watches and context.foresee is not None:
            self.asked = context, order, reasons_of(self._policy, context), context.foresee()
        return order


def explain_frame(
    opened: Map, sequence: DriveSequence, number: int, settings: Settings, options: RobotOptions
) -> Explanation:
    """Localises a drive up to a frame, and explains the order of its candidates.

    At that frame every candidate is attempted, to see which would match; before it only what the
    budget allows.

    Args:
        number: of the frame in the drive, from 0.
        options: ranking and budget of each frame up to and including this one.

    Raises:
        ConfigError: the drive has no such frame.
    """
    if number < 0:
        raise ConfigError(f"frame is {number}, must be 0 or more")
    watching = _Watching(policy_named(options.ranking))
    with (
        robot_on(opened, sequence, settings, options, watching) as robot,
        closing(arriving(sequence)) as frames,
    ):
        for at, arrived in enumerate(frames):
            watching.watches = at == number
            result = robot.step(arrived)
            if at == number:
                assert robot.last is not None
                found = Explanation(
                    number,
                    result.stamp_ns,
                    options.ranking,
                    result.status,
                    refused=robot.last.refused,
                )
                return _with_candidates(found, opened, watching, robot.last)
    raise ConfigError(f"the drive has no frame {number}; it has {len(sequence)}")


def _with_candidates(
    found: Explanation, opened: Map, watching: _Watching, last: LastFrame
) -> Explanation:
    if watching.asked is None:
        return found
    context, order, reasons, foreseen = watching.asked
    attempted = {outcome.candidate.index for outcome in last.outcomes}
    near, rates = context.neighbourhood, context.success_rates()
    drives = _drives(opened)
    candidates = []
    for row in order.tolist():
        node = context.graph.node(int(near.nodes[row]))
        candidates.append(
            ExplainedCandidate(
                node=node.id,
                session=node.session,
                drive=drives.get(node.session, "unknown"),
                distance_m=float(near.distance_m[row]),
                along_m=float(near.along_m[row]),
                across_m=float(near.across_m[row]),
                yaw_rad=float(near.yaw_rad[row]),
                success_rate=float(rates[row]),
                chance=None if reasons.chances is None else float(reasons.chances[row]),
                by_turn=reasons.by_turn is not None and bool(reasons.by_turn[row]),
                terms={name: float(values[row]) for name, values in reasons.terms.items()},
                attempted=int(near.nodes[row]) in attempted,
                would_match=bool(foreseen.accepted[row]),
                inliers=int(foreseen.inliers[row]),
            )
        )
    return replace(found, meaning=reasons.meaning, rule=reasons.rule, candidates=tuple(candidates))


def _drives(opened: Map) -> dict[SessionId, str]:
    """Robot and start of each session, as text."""
    words = {}
    for session in opened.sessions.values():
        if session.clock is Clock.UTC:
            began = datetime.fromtimestamp(session.begin_ns / 1e9, UTC)
            words[session.id] = f"{session.robot} {began:%Y-%m-%d %H:%M}"
        else:
            words[session.id] = f"{session.robot} {str(session.id)[:8]}"
    return words
