"""Which match of a frame its result is of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from engram.geometry import SE3
from engram.graph.model import NodeId
from engram.localiser.acceptance import AcceptanceConfig, Rule
from engram.localiser.attempts import Outcome


def uncontested(outcomes: Sequence[Outcome], config: AcceptanceConfig) -> list[Outcome]:
    """Outcomes of one frame, of which those stay accepted that no other match contests.

    In rain twenty inliers may agree by chance, a metre off. Often another match of the frame has
    nearly as many, lies elsewhere, and nearer to where odometry puts the robot.
    """
    if len(outcomes) < 2 or not any(one.accepted for one in outcomes):
        return list(outcomes)
    moved = [_correction(one) for one in outcomes]

    def contested(at: int) -> bool:
        mine = moved[at]
        return mine is not None and any(
            its is not None
            and rival.match.inliers >= config.rival_share * outcomes[at].match.inliers
            and its.distance_m < mine.distance_m
            and np.linalg.norm(its.translation - mine.translation) > config.slack_m
            for rival, its in zip(outcomes, moved, strict=True)
        )

    return [
        replace(one, accepted=False) if one.accepted and contested(at) else one
        for at, one in enumerate(outcomes)
    ]


def _correction(outcome: Outcome) -> SE3 | None:
    """The measured pose of the live camera in the predicted one; None unless both are known."""
    prediction, measured = outcome.candidate.prediction, outcome.match.reference_from_live
    if prediction is None or measured is None:
        return None
    return prediction.node_from_live.inverse() @ measured


def best_success(outcomes: Sequence[Outcome], rule: Rule) -> Outcome | None:
    """The accepted outcome that is surest, then of the best rank (method §3.2).

    By the published rule that is the one with the most inliers. In rain, of two matches of one
    frame the one with a few more of them is sometimes a metre off.
    """
    successes = [outcome for outcome in outcomes if outcome.accepted]

    def least(one: Outcome) -> tuple[float, int]:
        return -(one.confidence if rule is Rule.CONFIDENCE else one.match.inliers), one.rank

    return min(successes, key=least, default=None)


def outcome_at(outcomes: Sequence[Outcome], node: NodeId | None) -> Outcome | None:
    """The accepted outcome of a node, as that of a result; None if there is none."""
    return next((one for one in outcomes if one.accepted and one.candidate.node == node), None)
