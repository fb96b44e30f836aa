"""Whether a match is believed: the cheap second half of an attempt (SPEC §3.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from engram.errors import ConfigError
from engram.frontend import Frame
from engram.frontend.matching import Match
from engram.geometry import SE3


@dataclass(frozen=True, slots=True)
class AcceptanceConfig:
    """When a match counts as a localisation.

    Attributes:
        min_inliers: fewest inliers. Source: SPEC §3, 20.
        min_inliers_lost: fewest inliers where no prediction speaks for the match: a wrong place
            must not pass. Two unlike places that share a shop front and a car reach 30 in a
            simulated town; right places in like light have 100 and more.
        min_spread_lost: least share of the image's width or height over which the inliers spread
            where no prediction speaks for the match. Two cars of one make match as well as two
            views of one place; a car seldom fills a third of the image.
        reach_m: how far from a node a robot without a prediction may be found. A straight road is
            recognised from 30 m away, but a robot found there is outside the neighbourhood of the
            node, and would be lost again. Source: SPEC §3, search radius 8 m.
        slack_m, slack_rad: disagreement with the prediction that is forgiven on top of three
            standard deviations. Source: SPEC §3, 1 m and 10°.
    """

    min_inliers: int = 20
    min_inliers_lost: int = 40
    min_spread_lost: float = 1 / 3
    reach_m: float = 8.0
    slack_m: float = 1.0
    slack_rad: float = float(np.deg2rad(10.0))

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if not 0 <= value < np.inf:
                raise ConfigError(f"acceptance: {one.name} is {value}, must be finite and >= 0")


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where the live camera is expected, seen from one candidate node.

    Attributes:
        node_from_live: expected pose.
        sigma_m, sigma_yaw_rad: its standard deviations.
    """

    node_from_live: SE3
    sigma_m: float
    sigma_yaw_rad: float


def accept(
    match: Match,
    prediction: Prediction | None,
    config: AcceptanceConfig,
    spread: float = 1.0,
) -> bool:
    """Whether the match is a localisation: enough inliers, and where it was expected.

    Args:
        match: the match of the live frame with one node.
        prediction: what was expected; None while the robot has no idea where it is.
        config: the thresholds.
        spread: `inlier_spread` of the match; looked at only where there is no prediction.
    """
    if match.reference_from_live is None:
        return False
    if prediction is None:
        return (
            match.inliers >= config.min_inliers_lost
            and spread >= config.min_spread_lost
            and match.reference_from_live.distance_m <= config.reach_m
        )
    if match.inliers < config.min_inliers:
        return False
    predicted, found = prediction.node_from_live, match.reference_from_live
    apart_m = found.translation - predicted.translation
    if apart_m @ apart_m > (config.slack_m + 3 * prediction.sigma_m) ** 2:
        return False
    # tr(PᵀF) is the sum of the products of their entries; its angle as in SE3.angle_rad, which is
    # exacter near 0 and slower: evaluations come by here a hundred million times.
    cosine = 0.5 * (float(np.vdot(predicted.rotation, found.rotation)) - 1.0)
    turn_rad = math.acos(min(max(cosine, -1.0), 1.0))
    return turn_rad <= config.slack_rad + 3 * prediction.sigma_yaw_rad


def inlier_spread(match: Match, reference: Frame, live: Frame) -> float:
    """Share of the image over which the inliers spread, the smaller of the two images'.

    In each image the larger of two shares: of the width and of the height that lie between the
    first and the last tenth of the inliers.
    """
    if match.inliers == 0:
        return 0.0
    spreads = []
    for frame, rows in ((reference, match.reference_rows), (live, match.live_rows)):
        low, high = np.percentile(frame.landmarks.pixels[rows], [10, 90], axis=0)
        size = np.array([frame.camera.width, frame.camera.height])
        spreads.append(float(((high - low) / size).max()))
    return min(spreads)
