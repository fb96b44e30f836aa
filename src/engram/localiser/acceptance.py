"""When a match is accepted: inliers, their spread over the image, the lens.

Nodes as a camera with another lens sees them best: from farther behind, or farther ahead. A longer
lens shows the same scene larger. A live frame is most alike a node of a shorter lens where it
stands behind it, so that both show the scene at one scale. The offset grows with the ratio of the
focal lengths and the usual depth of what matches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from engram.config import PUBLIC
from engram.errors import ConfigError
from engram.frontend.frame import Frame
from engram.frontend.matching import Match
from engram.geometry.cameras import CameraId, StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Session, SessionId
from engram.graph.neighbourhood import Neighbourhood


@dataclass(frozen=True, slots=True)
class Spread:
    """Extent of a match's inliers, from their 10th to their 90th percentile.

    Attributes:
        image: share of the image: geometric mean of the shares of its width and its height.
        height: extent along the camera's y axis, as a share of that of all landmarks of the frame.
        depth_m: median depth in front of the camera, metres.
    """

    image: float
    height: float
    depth_m: float


def inlier_spread(match: Match, reference: Frame, live: Frame) -> Spread:
    """The extent of a match's inliers; of each measure, the smaller of the two frames."""
    if match.inliers == 0:
        return Spread(0.0, 0.0, 0.0)
    spreads = []
    for frame, rows in ((reference, match.reference_rows), (live, match.live_rows)):
        size = (frame.camera.width, frame.camera.height)
        width, height = _extent(frame.landmarks.pixels[rows] / size).tolist()
        height_m = frame.landmarks.points_in_cam[:, 1]
        whole_m = max(float(_extent(height_m)), np.finfo(np.float64).tiny)
        share = float(_extent(height_m[rows])) / whole_m
        depth_m = _median(frame.landmarks.points_in_cam[rows, 2])
        spreads.append((math.sqrt(width * height), share, depth_m))
    return Spread(*(min(values) for values in zip(*spreads, strict=True)))


def _extent(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """From the 10th to the 90th percentile, along the first axis.

    As `np.percentile` has it, to the bit, in a tenth of its time.
    """
    ordered = np.sort(values, axis=0)
    extent: NDArray[np.floating] = _percentile(ordered, 90) - _percentile(ordered, 10)
    return extent


def _median(values: NDArray[np.floating]) -> float:
    """As `np.median` has it, to the bit, in a fifth of its time."""
    ordered = np.sort(values)
    middle = len(ordered) // 2
    odd = len(ordered) % 2
    return float(ordered[middle] if odd else (ordered[middle - 1] + ordered[middle]) / 2)


def _percentile(ordered: NDArray[np.floating], percent: int) -> NDArray[np.floating]:
    place = percent / 100 * (len(ordered) - 1)
    below = math.floor(place)
    low, high = ordered[below], ordered[min(below + 1, len(ordered) - 1)]
    share = np.float64(place - below)
    value: NDArray[np.floating] = (
        high - (high - low) * (1 - share) if share >= 0.5 else low + (high - low) * share
    )
    return value


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
        min_inliers: fewest inliers of a match. Where a position that fixes confirmed predicts it,
            `confidence` weighs 12 and more.
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

    rule: Annotated[Rule, PUBLIC] = Rule.CONFIDENCE
    min_confidence: Annotated[float, PUBLIC] = 4.25
    min_confidence_told: float = 4.74
    min_confidence_lost: float = 5.39
    lost_long_m: float = 100.0
    sure_confidence: float = 7.01
    settle_after_m: float = 10.0
    join_share: float = 1 / 3
    join_after_m: float = 60.0
    doubt_after: Annotated[float, PUBLIC] = 3.0
    rival_share: float = 0.6
    min_inliers: Annotated[int, PUBLIC] = 20
    min_inliers_lost: Annotated[int, PUBLIC] = 60
    min_inliers_plausible: int = 35
    min_spread_lost: float = 0.25
    min_height_lost: float = 0.4
    reach_m: float = 8.0
    max_sigma_m: float = 0.5
    slack_m: float = 0.5
    slack_rad: float = float(np.deg2rad(5.0))

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Rule):
                continue
            if not 0 <= value < np.inf:
                raise ConfigError(f"acceptance: {field.name} is {value}, must be finite and >= 0")


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


class Lenses:
    """The focal lengths of a map's drives, compared with that of the live camera.

    Args:
        graph: the experience graph; it may grow.
        focal_px: of the live camera, which saves whatever is not in the map yet.
        depth_m: usual depth of what matches; 0 turns the correction off.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        sessions: Mapping[SessionId, Session],
        cameras: Mapping[CameraId, StereoCamera],
        focal_px: float,
        depth_m: float,
    ) -> None:
        self._graph = graph
        self._sessions, self._cameras = sessions, cameras
        self._focal_px, self._depth_m = focal_px, depth_m
        self._of_session = np.zeros(0)
        self._alike = True  # whether none of them shifts

    def shifts_m(self, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """(Y,) metres along the viewing direction at which nodes are most alike the live view."""
        self._look_at_sessions()
        return self._of_session[self._graph.sessions_of(nodes)]

    def _look_at_sessions(self) -> None:
        while len(self._of_session) < self._graph.session_count:
            session = self._sessions.get(self._graph.session(len(self._of_session)))
            camera = None if session is None else self._cameras.get(session.camera)
            shift_m = 0.0
            if camera is not None:
                shift_m = self._depth_m * (1 - self._focal_px / camera.fx)
            self._of_session = np.append(self._of_session, shift_m)
            self._alike = self._alike and not shift_m

    def as_seen(self, near: Neighbourhood) -> Neighbourhood:
        """Candidates with their offsets as by one lens; the very same if all lenses are."""
        self._look_at_sessions()
        if self._alike or not (shifts_m := self.shifts_m(near.nodes)).any():
            return near
        along_m = near.along_m - shifts_m
        height_m = near.node_from_live[:, 1, 3]
        distance_m = np.sqrt(along_m**2 + near.across_m**2 + height_m**2)
        return replace(near, along_m=along_m, distance_m=distance_m)
