"""Visual odometry: frames in temporal order → the motion between them (method §2.4)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram import _core
from engram.config import PUBLIC, check_bounds
from engram.errors import ConfigError, IncompatibleError
from engram.frontend.frame import Frame, FrameStatus
from engram.frontend.matching import MatcherConfig, check_same_kind, core_settings, features
from engram.geometry.se3 import SE3
from engram.odometry.step import Guess, OdometryStatus, OdometryStep


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """Settings of the joint optimisation.

    Attributes:
        frames: frames optimised together, including the newest. More gain nothing: of 500 landmarks
            fewer are then in sight.
        landmarks: most landmarks, longest tracks first; bounds the time.
        iterations: most iterations; one or two usually suffice. 0 skips the optimisation.
        pixel_sigma_px, disparity_sigma_px: standard deviations of a corner and of its disparity, to
            which the corner's octave and the disparity's own σ add. They are narrower than between
            matched views: the robust kernel then ignores what blur and drops on the lens drag
            along by half a pixel. Source: rendered towns.
        offset_sigma_px: standard deviation of the change of a rectified camera's disparity offset
            between successive windows. Each window starts from the last estimate, which converges
            within about ten frames.
    """

    frames: int = 6
    landmarks: int = 500
    iterations: int = 5
    pixel_sigma_px: float = 0.1
    disparity_sigma_px: float = 0.3
    offset_sigma_px: float = 0.1

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise ConfigError(f"window: frames is {self.frames}, must be ≥ 2")
        for name in ("pixel_sigma_px", "disparity_sigma_px", "offset_sigma_px"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"window: {name} is {getattr(self, name)}, must be > 0")
        for name, least in (("landmarks", 1), ("iterations", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"window: {name} is {getattr(self, name)}, must be ≥ {least}")


# In the order of the core's numbers.
_STATUSES = (
    OdometryStatus.FIRST,
    OdometryStatus.OK,
    OdometryStatus.TOO_FEW_MATCHES,
    OdometryStatus.NO_CONSENSUS,
)


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """Settings of `Odometry`.

    Attributes:
        matcher: how frames are matched. Corners of frames so near to each other are twice as exact
            as between views 0.4 to 2 m apart; more would let two motions pass as one.
        window: the joint optimisation.
        min_inliers: fewest landmarks that must agree on a motion.
        unexpected_inliers: most inliers that a motion needs after a gap in time, without a
            prediction: repeating lamps, trees and kerb stones match as well as the same place.
            `usual_share` of the usual number (median of the last steps) suffices if it is less.
        usual_share: see `unexpected_inliers`.
        few_inliers: see its description.
        plausible_inliers: sufficient inliers after a gap if the speed before it, changed by
            `acceleration_m_s2` throughout the gap, explains the motion; above every grossly wrong
            match on KITTI: the strongest of 846 has 30 inliers.
        acceleration_m_s2, angular_acceleration_rad_s2: standard deviations of the motion model,
            constant velocity. A car brakes with up to 8 m/s²; a head or a handlebar turns with
            10 rad/s² and more.
        max_prediction_s: over a longer interval matching searches the whole frame.
        steady_m, steady_rad: standard deviations of a step from one at the last speed. Of two
            motions that landmarks agree on, the one within twice these needs only `steady_share`
            of the other's inliers: rain and lamps make a second motion.
        steady_share: see `steady_m`.
        braking_m_s2: a step that takes more than half of the speed, faster than this since the last
            step that was not vague, is an impossible stop. A car brakes with up to 8.
        braking_share: what `steady_share` is against an impossible stop.
        disbelief_s: time after one for which the earlier speed stays the last speed, and the step's
            covariance covers both. No robot keeps its speed for much longer.
        keyframe_flow_px: a frame becomes a keyframe once its landmarks have moved this far in the
            image (median). Below it noise outweighs motion.
        keyframe_share: or once it shows less than this share of the keyframe's landmarks.
    """

    matcher: MatcherConfig = field(default_factory=lambda: MatcherConfig(pixel_sigma_px=0.35))
    window: WindowConfig = field(default_factory=WindowConfig)
    min_inliers: Annotated[int, Meta(ge=6), PUBLIC] = 15
    unexpected_inliers: Annotated[int, Meta(ge=6)] = 60
    usual_share: Annotated[float, Meta(ge=0, le=1)] = 0.4
    plausible_inliers: Annotated[int, Meta(ge=6)] = 35
    few_inliers: Annotated[
        float,
        Meta(
            ge=0,
            description="variances of a step grow by the square of this number over that of its "
            "inliers: neighbouring corners err alike, the more so in rain and at night. "
            "Source: `lab/reports/trust.md`",
        ),
    ] = 350.0
    acceleration_m_s2: float = 4.0
    angular_acceleration_rad_s2: float = 5.0
    max_prediction_s: float = 0.5
    steady_m: Annotated[float, Meta(gt=0)] = 0.05
    steady_rad: Annotated[float, Meta(gt=0)] = 0.01
    steady_share: Annotated[float, Meta(gt=0, le=1)] = 0.5
    braking_m_s2: Annotated[float, Meta(gt=0)] = 10.0
    braking_share: Annotated[float, Meta(gt=0, le=1)] = 0.3
    disbelief_s: Annotated[float, Meta(ge=0)] = 2.0
    keyframe_flow_px: float = 10.0
    keyframe_share: float = 0.4

    def __post_init__(self) -> None:
        check_bounds(self)


class Odometry:
    """Estimates the motion of one camera from frame to frame.

    Frames are matched to the last *keyframe*, not to the previous frame, so that errors do not add
    up while the camera rests or moves slowly. The motion between successive frames follows by
    composition. The last keyframes and the landmarks that they share are optimised together. The
    core keeps them; its twin in Python is `tests/reference/odometry.py`.
    """

    def __init__(self, config: OdometryConfig | None = None) -> None:
        self._core = _core.Odometry(_settings(config or OdometryConfig()))
        self._last: Frame | None = None

    def step(self, frame: Frame, expected: Guess | None = None) -> OdometryStep:
        """The motion since the last usable frame; see `OdometryStep` for failures.

        Args:
            frame: the next frame.
            expected: the motion by wheels and gyroscope, which guides the match where the last
                speed says nothing; None if unknown.

        Source: method §2.4; [G16] §III-A.
        """
        if frame.status is not FrameStatus.OK:
            return OdometryStep(OdometryStatus.UNUSABLE_FRAME)
        self._check_same(frame)
        guide: tuple[NDArray[np.float64], ...] = ()
        if expected is not None and expected.has_way:
            guide = expected.prev_from_curr.matrix(), expected.covariance
        status, rotation, translation, covariance, inliers = self._core.step(
            features(frame), frame.stamp_ns, *guide
        )
        self._last = frame
        if rotation is None or translation is None:
            return OdometryStep(_STATUSES[status])
        motion = SE3(rotation, translation)
        return OdometryStep(_STATUSES[status], motion, covariance, inliers)

    def _check_same(self, frame: Frame) -> None:
        last = self._last
        if last is None:
            return
        if frame.camera != last.camera:
            raise IncompatibleError(
                "the camera changed within a drive; use a separate odometry for each camera"
            )
        check_same_kind(last, frame)


def _settings(config: OdometryConfig) -> _core.OdometrySettings:
    settings = _core.OdometrySettings()
    for name in OdometryConfig.__dataclass_fields__:
        if name not in {"matcher", "window"}:
            setattr(settings, name, getattr(config, name))
    for name in WindowConfig.__dataclass_fields__:
        setattr(settings, f"window_{name}", getattr(config.window, name))
    settings.match = core_settings(config.matcher, same_camera=True)
    return settings
