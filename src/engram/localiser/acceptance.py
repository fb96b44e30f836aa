"""Acceptance of a match: the cheap second half of an attempt (method §3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from enum import StrEnum

import numpy as np

from engram.errors import ConfigError
from engram.frontend.matching import Match
from engram.geometry import SE3
from engram.graph.neighbourhood import Neighbourhood
from engram.localiser.spread import Spread


class Rule(StrEnum):
    """What decides whether a match is a localisation."""

    CONFIDENCE = "confidence"
    INLIERS = "inliers"


@dataclass(frozen=True, slots=True)
class AcceptanceConfig:
    """When a match counts as a localisation.

    Source of the values: method §3, and trials on simulated drives (`lab/reports/constants.md`).

    Attributes:
        rule: `confidence` weighs all evidence (`engram.localiser.confidence`); `inliers` is the
            published rule, `min_inliers` near the prediction, and the stricter one below for a
            lost robot.
        min_confidence: minimum log-odds of a match near the predicted position. At the threshold,
            one match in seventy is wrong.
        min_confidence_told: the same while no fix has confirmed the position: the caller may have
            set a wrong one, and streets look alike.
        min_confidence_lost: the same for a match without a prediction: many such are tried.
        lost_long_m: distance without a match, metres, beyond which a lost robot accepts a single
            match only from `sure_confidence` on, and others if they agree over
            `hypotheses.long_base_line_m`: the further it drives, the more look-alike places it
            has tried, and the less likely it is that the map shows the road at all.
        sure_confidence: log-odds from which one fix, without earlier ones, is accepted
            permanently.
        settle_after_m: distance over which weaker fixes must agree to be accepted permanently,
            metres. Until then a contradicting fix withdraws them, and no edge is created from them.
        join_share, join_after_m: a disconnected drive joins the map only after fixes agree over
            this fraction of its disconnected distance, at most `join_after_m` metres, however
            sure they are: the longer a drive stays disconnected, the more look-alike streets it
            passes, some of them alike over tens of metres.
        doubt_after: number of expected but missing fixes since the last one after which a robot
            searches the whole map; so does a robot whose position was set by the caller, until
            its first fix. 0: neither does, before it is lost.
        rival_share: a match is refused if another of the frame, with this share of its inliers,
            lies more than `slack_m` from it and nearer to the prediction.
        min_inliers: fewest inliers of a match with a prediction.
        min_inliers_lost: fewest inliers of a match without a prediction; above every wrong match
            that passes the other tests.
        min_inliers_plausible: fewest inliers of a lost robot's match that counts only after a
            second match farther along agrees with it (`Hypotheses`).
        min_spread_lost: least share of the image that the inliers of a match without a prediction
            cover. One facade or one car is not a place.
        min_height_lost: least vertical extent of these inliers, as a share of that of all
            landmarks in the frame. Parked cars and road texture recur in many streets, and are
            low. A share, because indoors everything is low.
        reach_m: farthest from a node that a robot without a prediction may be found, metres. A
            robot found beyond the search radius of the node would be lost again.
        max_sigma_m: largest uncertainty of a match's position (root of the summed variances),
            metres. A match on few or distant landmarks determines the heading at best.
        slack_m, slack_rad: disagreement with the prediction allowed beyond three standard
            deviations. At larger values most additional matches are wrong.
    """

    rule: Rule = Rule.CONFIDENCE
    min_confidence: float = 4.25
    min_confidence_told: float = 4.74
    min_confidence_lost: float = 5.39
    lost_long_m: float = 100.0
    sure_confidence: float = 7.01
    settle_after_m: float = 10.0
    join_share: float = 1 / 3
    join_after_m: float = 60.0
    doubt_after: float = 3.0
    rival_share: float = 0.6
    min_inliers: int = 20
    min_inliers_lost: int = 60
    min_inliers_plausible: int = 35
    min_spread_lost: float = 0.25
    min_height_lost: float = 0.4
    reach_m: float = 8.0
    max_sigma_m: float = 0.5
    slack_m: float = 0.5
    slack_rad: float = float(np.deg2rad(5.0))

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if isinstance(value, Rule):
                continue
            if not 0 <= value < np.inf:
                raise ConfigError(f"acceptance: {one.name} is {value}, must be finite and >= 0")


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where the live camera is expected, seen from one candidate node.

    Attributes:
        node_from_live: expected pose of the live camera in the node's camera.
        sigma_m, sigma_yaw_rad: its standard deviations of position and heading.
    """

    node_from_live: SE3
    sigma_m: float
    sigma_yaw_rad: float

    @staticmethod
    def of(neighbourhood: Neighbourhood, row: int) -> Prediction:
        """The prediction for one candidate, a row of a neighbourhood."""
        matrix = neighbourhood.node_from_live[row]
        return Prediction(
            SE3(matrix[:3, :3], matrix[:3, 3]),
            float(neighbourhood.sigma_m[row]),
            float(neighbourhood.sigma_yaw_rad[row]),
        )


def accept(match: Match, prediction: Prediction, config: AcceptanceConfig) -> bool:
    """Whether a match is a localisation: enough inliers, the expected pose, low uncertainty.

    Args:
        match: the match of the live frame with one node.
        prediction: what was expected.
        config: the thresholds.
    """
    if match.reference_from_live is None or match.inliers < config.min_inliers:
        return False
    return agrees(match.reference_from_live, prediction, config) and determined(match, config)


def agrees(node_from_live: SE3, prediction: Prediction, config: AcceptanceConfig) -> bool:
    """Whether a pose lies within three standard deviations and the slack of its prediction."""
    predicted = prediction.node_from_live
    apart_m = node_from_live.translation - predicted.translation
    if apart_m @ apart_m > (config.slack_m + 3 * prediction.sigma_m) ** 2:
        return False
    # tr(PᵀF) is the sum of the products of their entries. SE3.angle_rad is more exact near 0 but
    # slower, and evaluations call this most often.
    cosine = 0.5 * (float(np.vdot(predicted.rotation, node_from_live.rotation)) - 1.0)
    turn_rad = math.acos(min(max(cosine, -1.0), 1.0))
    return turn_rad <= config.slack_rad + 3 * prediction.sigma_yaw_rad


def apart(node_from_live: SE3, prediction: Prediction, config: AcceptanceConfig) -> float:
    """Distance of a pose from its prediction over the standard deviation and a share of slack.

    Infinite if the two contradict each other.
    """
    if not agrees(node_from_live, prediction, config):
        return math.inf
    apart_m = node_from_live.translation - prediction.node_from_live.translation
    return math.sqrt(apart_m @ apart_m) / math.hypot(prediction.sigma_m, config.slack_m / 3)


def accept_lost(match: Match, spread: Callable[[], Spread], config: AcceptanceConfig) -> bool:
    """Whether a match without a prediction is a localisation.

    Args:
        match: the match of the live frame with one node.
        spread: computes `inlier_spread` of the match; called only if it decides.
        config: the thresholds.
    """
    return match.inliers >= config.min_inliers_lost and plausible(match, spread, config)


def plausible(match: Match, spread: Callable[[], Spread], config: AcceptanceConfig) -> bool:
    """Whether a match without a prediction would be a localisation if a second one agreed."""
    pose = match.reference_from_live
    if pose is None or match.inliers < config.min_inliers_plausible:
        return False
    if pose.distance_m > config.reach_m or not determined(match, config):
        return False
    over = spread()
    return over.image >= config.min_spread_lost and over.height >= config.min_height_lost


def determined(match: Match, config: AcceptanceConfig) -> bool:
    """Whether a match that has a pose determines the position well enough."""
    assert match.covariance is not None
    x, y, z = match.covariance.diagonal()[:3].tolist()
    return bool(x + y + z <= config.max_sigma_m**2)
