"""Whether a match is believed: the cheap second half of an attempt (SPEC §3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError
from engram.frontend import Frame
from engram.frontend.matching import Match
from engram.geometry import SE3
from engram.graph.neighbourhood import Neighbourhood


@dataclass(frozen=True, slots=True)
class AcceptanceConfig:
    """When a match counts as a localisation.

    What is said below of lost robots was judged on 1,050 frames of five `village` drives, each
    matched with the nodes near it (4,500 right matches) and the likeliest others (50,000 wrong).

    Attributes:
        min_inliers: fewest inliers. Source: SPEC §3, 20.
        min_inliers_lost: fewest inliers where no prediction speaks for the match: a wrong place
            must not pass. The best wrong match that passes the two tests below had 46 there, and
            50 in another town.
        min_inliers_plausible: fewest inliers of a lost robot's match that is believed once a second
            one, some way on, agrees with it (`Hypotheses`).
        min_spread_lost: least share of the image over which the inliers spread where no prediction
            speaks for the match. One facade's windows or one car match as well as two views of one
            place. 0.5 % of the right matches have less than 0.28.
        min_height_lost: least share over which they spread there of the height over which all
            landmarks of the frame do. Parked cars of one make, and the texture of a road, are found
            in many streets, and are low. Of 1,233 other right matches of 35 to 80 inliers 2.4 %
            have less than 0.4. A share, since indoors everything is low.
        reach_m: how far from a node a robot without a prediction may be found. A straight road is
            recognised from 30 m away, but a robot found there is outside the neighbourhood of the
            node, and would be lost again. Source: SPEC §3, search radius 8 m.
        max_sigma_m: how uncertain the position of a match may be (root of the summed variances).
            A match that hangs on few or distant landmarks tells the heading at best: of 1,220
            such matches of five `village@2` drives 235 were more than 1 m off, of 39,600 others
            1.5 %. None of them was the only match of more than 0.05 % of the route.
        slack_m, slack_rad: disagreement with the prediction that is forgiven on top of three
            standard deviations. They were 1 m and 10° at first. Of 83,471
            unguided matches of five `village@2` drives that were accepted so, 298 were more than
            1 m or 5° off; with these two 102 are, and 84 right ones are lost. Between 0.5 and 1 m
            two matches of three are wrong, however many inliers they have.
    """

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

    @staticmethod
    def of(neighbourhood: Neighbourhood, row: int) -> Prediction:
        """That of one candidate of a neighbourhood."""
        matrix = neighbourhood.node_from_live[row]
        return Prediction(
            SE3(matrix[:3, :3], matrix[:3, 3]),
            float(neighbourhood.sigma_m[row]),
            float(neighbourhood.sigma_yaw_rad[row]),
        )


@dataclass(frozen=True, slots=True)
class Spread:
    """How much of what the cameras see agrees: first to last tenth of a match's inliers.

    Attributes:
        image: share of the image, the geometric mean of that of the width and that of the height.
        height: extent along the camera's y axis, as a share of that of all landmarks of the frame.
        depth_m: how far in front of the camera their median is.
    """

    image: float
    height: float
    depth_m: float


def accept(match: Match, prediction: Prediction, config: AcceptanceConfig) -> bool:
    """Whether a match is a localisation: enough inliers, where it was expected, and certain.

    Args:
        match: the match of the live frame with one node.
        prediction: what was expected.
        config: the thresholds.
    """
    if match.reference_from_live is None or match.inliers < config.min_inliers:
        return False
    return agrees(match.reference_from_live, prediction, config) and _certain(match, config)


def agrees(node_from_live: SE3, prediction: Prediction, config: AcceptanceConfig) -> bool:
    """Whether a pose is where it was expected."""
    predicted = prediction.node_from_live
    apart_m = node_from_live.translation - predicted.translation
    if apart_m @ apart_m > (config.slack_m + 3 * prediction.sigma_m) ** 2:
        return False
    # tr(PᵀF) is the sum of the products of their entries; its angle as in SE3.angle_rad, which is
    # exacter near 0 and slower: evaluations come by here a hundred million times.
    cosine = 0.5 * (float(np.vdot(predicted.rotation, node_from_live.rotation)) - 1.0)
    turn_rad = math.acos(min(max(cosine, -1.0), 1.0))
    return turn_rad <= config.slack_rad + 3 * prediction.sigma_yaw_rad


def accept_lost(match: Match, spread: Callable[[], Spread], config: AcceptanceConfig) -> bool:
    """Whether a match is a localisation though nothing was expected.

    Args:
        match: the match of the live frame with one node.
        spread: gives `inlier_spread` of the match; asked only where it decides.
        config: the thresholds.
    """
    return match.inliers >= config.min_inliers_lost and plausible(match, spread, config)


def plausible(match: Match, spread: Callable[[], Spread], config: AcceptanceConfig) -> bool:
    """Whether a match would be a localisation if a second one agreed with it."""
    pose = match.reference_from_live
    if pose is None or match.inliers < config.min_inliers_plausible:
        return False
    if pose.distance_m > config.reach_m or not _certain(match, config):
        return False
    over = spread()
    return over.image >= config.min_spread_lost and over.height >= config.min_height_lost


def _certain(match: Match, config: AcceptanceConfig) -> bool:
    """Whether a match that has a pose says well enough where the robot is."""
    assert match.covariance is not None
    x, y, z = match.covariance.diagonal()[:3].tolist()
    return bool(x + y + z <= config.max_sigma_m**2)


def inlier_spread(match: Match, reference: Frame, live: Frame) -> Spread:
    """Over how much the inliers spread, the smaller of the two images'."""
    if match.inliers == 0:
        return Spread(0.0, 0.0, 0.0)
    spreads = []
    for frame, rows in ((reference, match.reference_rows), (live, match.live_rows)):
        size = (frame.camera.width, frame.camera.height)
        width, height = _extent(frame.landmarks.pixels[rows] / size).tolist()
        height_m = frame.landmarks.points_in_cam[:, 1]
        whole_m = max(float(_extent(height_m)), np.finfo(np.float64).tiny)
        share = float(_extent(height_m[rows])) / whole_m
        depth_m = float(np.median(frame.landmarks.points_in_cam[rows, 2]))
        spreads.append((math.sqrt(width * height), share, depth_m))
    return Spread(*(min(values) for values in zip(*spreads, strict=True)))


def _extent(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """From the first to the last tenth, along the first axis."""
    low, high = np.percentile(values, [10, 90], axis=0)
    extent: NDArray[np.floating] = high - low
    return extent
