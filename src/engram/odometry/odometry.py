"""Visual odometry: frames in temporal order → the motion between them (SPEC §2.4)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.errors import IncompatibleError
from engram.frontend import Frame, FrameStatus, Match, MatcherConfig, match_frames
from engram.geometry import SE3, propagate_covariance
from engram.odometry.outside import Guess
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.odometry.window import Window, WindowConfig

_S_PER_NS = 1e-9
# Steps that determine the usual number of inliers and the usual interval.
_USUAL_OF = 20
# Frames are missing if one comes later than this many usual intervals after the last.
_GAP_RATIO = 1.5


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """Settings of `Odometry`.

    Attributes:
        matcher: how frames are matched.
        window: the joint optimisation.
        min_inliers: fewest landmarks that must agree on a motion.
        unexpected_inliers: most inliers that a motion needs after a gap in time, without a
            prediction: repeating lamps, trees and kerb stones match as well as the same place.
            `usual_share` of the usual number (median of the last steps) suffices if it is less.
        usual_share: see `unexpected_inliers`.
        plausible_inliers: sufficient inliers after a gap if the speed before it, changed by
            `acceleration_m_s2` throughout the gap, explains the motion; above every grossly wrong
            match on KITTI (`lab/reports/constants.md`).
        acceleration_m_s2, angular_acceleration_rad_s2: standard deviations of the motion model,
            constant velocity. A car brakes with up to 8 m/s²; a head or a handlebar turns with
            10 rad/s² and more.
        max_prediction_s: over a longer interval matching searches the whole frame.
        keyframe_flow_px: a frame becomes a keyframe once its landmarks have moved this far in the
            image (median). Below it noise outweighs motion.
        keyframe_share: or once it shows less than this share of the keyframe's landmarks.
    """

    matcher: MatcherConfig = field(default_factory=MatcherConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    min_inliers: Annotated[int, Meta(ge=6)] = 15
    unexpected_inliers: Annotated[int, Meta(ge=6)] = 60
    usual_share: Annotated[float, Meta(ge=0, le=1)] = 0.4
    plausible_inliers: Annotated[int, Meta(ge=6)] = 35
    acceleration_m_s2: float = 4.0
    angular_acceleration_rad_s2: float = 5.0
    max_prediction_s: float = 0.25
    keyframe_flow_px: float = 10.0
    keyframe_share: float = 0.3

    def __post_init__(self) -> None:
        check_bounds(self)


class Odometry:
    """Estimates the motion of one camera from frame to frame.

    Frames are matched to the last *keyframe*, not to the previous frame, so that errors do not add
    up while the camera rests or moves slowly. The motion between successive frames follows by
    composition.
    """

    def __init__(self, config: OdometryConfig | None = None) -> None:
        self._config = config or OdometryConfig()
        self._track: _Track | None = None
        # Inliers and intervals, s, of the last steps, for this camera and light.
        self._inliers: deque[int] = deque(maxlen=_USUAL_OF)
        self._intervals: deque[float] = deque(maxlen=_USUAL_OF)

    def step(self, frame: Frame, expected: Guess | None = None) -> OdometryStep:
        """The motion since the last usable frame; see `OdometryStep` for failures.

        Args:
            frame: the next frame.
            expected: the motion by wheels and gyroscope, which guides the match where the last
                speed says nothing; None if unknown.

        Raises:
            IncompatibleError: the camera or the kind of descriptors differs from that of the
                previous frame.

        Source: SPEC §2.4; [G16] §III-A.
        """
        if frame.status is not FrameStatus.OK:
            return OdometryStep(OdometryStatus.UNUSABLE_FRAME)
        if self._track is None:
            self._track = _Track(frame, self._config)
            return OdometryStep(OdometryStatus.FIRST)

        interval_s = (frame.stamp_ns - self._track.stamp_ns) * _S_PER_NS
        match = self._track.match(frame, expected)
        if not self._believes(match, interval_s):
            self._track = _Track(frame, self._config, self._track.offset_px)
            return OdometryStep(_reason(match))

        self._inliers.append(match.inliers)
        self._intervals.append(interval_s)
        keyframe_from_curr, covariance = self._track.place(frame, match)
        return self._track.advance(frame, match, keyframe_from_curr, covariance)

    def _believes(self, match: Match, interval_s: float) -> bool:
        """Whether enough landmarks agree on the motion; after a gap in time more are needed."""
        config = self._config
        if match.inliers < config.min_inliers or not self._is_gap(interval_s):
            return match.inliers >= config.min_inliers
        usual = float(np.median(self._inliers)) if self._inliers else np.inf
        needed = np.clip(config.usual_share * usual, config.min_inliers, config.unexpected_inliers)
        if match.inliers >= needed:
            return True
        assert self._track is not None
        return match.inliers >= config.plausible_inliers and self._track.explains(match, interval_s)

    def _is_gap(self, interval_s: float) -> bool:
        """Whether frames are missing, judged by the camera's usual interval."""
        if 0 < interval_s <= self._config.max_prediction_s:
            return False
        usual_s = float(np.median(self._intervals)) if self._intervals else 0.0
        return not 0 < interval_s <= _GAP_RATIO * usual_s


class _Track:
    """An unbroken run of frames: the window, the last motion, the pose of the previous frame."""

    def __init__(self, first: Frame, config: OdometryConfig, offset_px: float = 0.0) -> None:
        self._config = config
        self._window = Window(first, config.window, config.matcher, offset_px)
        self.stamp_ns = first.stamp_ns
        self._keyframe_from_prev = SE3.identity()
        self._covariance = np.zeros((6, 6))  # of keyframe_from_prev
        self._velocity: NDArray[np.float64] | None = None  # (6,) tangent per second

    @property
    def offset_px(self) -> float:
        """The camera's estimated disparity offset, px; kept when the chain breaks."""
        return self._window.offset_px

    def explains(self, match: Match, interval_s: float) -> bool:
        """Whether the last speed, with acceleration or braking, explains a match's pose."""
        if self._velocity is None or match.reference_from_live is None:
            return False
        prev_from_curr = self._keyframe_from_prev.inverse() @ match.reference_from_live
        changed_m = np.linalg.norm(prev_from_curr.log()[:3] - self._velocity[:3] * interval_s)
        return bool(changed_m <= 0.5 * self._config.acceleration_m_s2 * interval_s**2)

    def match(self, frame: Frame, expected: Guess | None = None) -> Match:
        """Match to the keyframe; if that fails, to the previous frame."""
        if frame.camera != self._window.keyframe.camera:
            raise IncompatibleError(
                "the camera changed within a drive; use a separate odometry for each camera"
            )
        match = self._match_to_keyframe(frame, expected)
        if match.inliers < self._config.min_inliers and self._window.has_newest:
            self._keep_previous_as_keyframe()
            match = self._match_to_keyframe(frame, expected)
        return match

    def place(self, frame: Frame, match: Match) -> tuple[SE3, NDArray[np.float64]]:
        """keyframe_from_curr after joint optimisation, with its (6, 6) covariance."""
        self._window.add(frame, match)
        return self._window.optimise(match)

    def advance(
        self,
        frame: Frame,
        match: Match,
        keyframe_from_curr: SE3,
        covariance: NDArray[np.float64],
    ) -> OdometryStep:
        """Make the frame the previous one; returns the motion that led to it.

        Args:
            frame: the frame.
            match: its match to the keyframe.
            keyframe_from_curr: its pose in the keyframe.
            covariance: (6, 6) float64 of that pose, left perturbation, [translation, rotation].
        """
        prev_from_keyframe = self._keyframe_from_prev.inverse()
        prev_from_curr = prev_from_keyframe @ keyframe_from_curr
        carry = prev_from_keyframe.adjoint()
        step = OdometryStep(
            OdometryStatus.OK,
            prev_from_curr,
            carry @ (self._covariance + covariance) @ carry.T,
            match.inliers,
        )
        interval_s = (frame.stamp_ns - self.stamp_ns) * _S_PER_NS
        self._velocity = prev_from_curr.log() / interval_s if interval_s > 0 else None
        self.stamp_ns = frame.stamp_ns
        self._keyframe_from_prev, self._covariance = keyframe_from_curr, covariance
        if self._has_moved_on(frame, match):
            self._keep_previous_as_keyframe()
        return step

    def _match_to_keyframe(self, frame: Frame, expected: Guess | None) -> Match:
        """Guided by constant velocity or what is expected; if that fails, unguided."""
        key, matcher = self._window.keyframe, self._config.matcher
        seed = frame.stamp_ns % 2**64
        prediction = self._predict(frame, expected)
        if prediction is not None:
            match = match_frames(key, frame, matcher, seed, *prediction)
            if match.inliers >= self._config.min_inliers:
                return match
        return match_frames(key, frame, matcher, seed)

    def _predict(
        self, frame: Frame, expected: Guess | None
    ) -> tuple[SE3, NDArray[np.float64]] | None:
        interval_s = (frame.stamp_ns - self.stamp_ns) * _S_PER_NS
        if self._velocity is None or not 0 < interval_s <= self._config.max_prediction_s:
            if expected is None or not expected.has_way:
                return None
            return (
                self._keyframe_from_prev @ expected.prev_from_curr,
                propagate_covariance(
                    self._keyframe_from_prev, self._covariance, expected.covariance
                ),
            )
        prev_from_curr = SE3.exp(self._velocity * interval_s)
        sigma = np.repeat(
            [self._config.acceleration_m_s2, self._config.angular_acceleration_rad_s2], 3
        )
        noise = np.diag((sigma * interval_s**2) ** 2)
        return (
            self._keyframe_from_prev @ prev_from_curr,
            propagate_covariance(self._keyframe_from_prev, self._covariance, noise),
        )

    def _keep_previous_as_keyframe(self) -> None:
        self._window.keep_newest()
        self._keyframe_from_prev = SE3.identity()
        self._covariance = np.zeros((6, 6))

    def _has_moved_on(self, frame: Frame, match: Match) -> bool:
        before = self._window.keyframe.landmarks
        if match.inliers < self._config.keyframe_share * min(len(before), len(frame.landmarks)):
            return True
        flow = frame.landmarks.pixels[match.live_rows] - before.pixels[match.reference_rows]
        return bool(np.median(np.abs(flow).max(axis=1)) > self._config.keyframe_flow_px)


def _reason(match: Match) -> OdometryStatus:
    if match.reference_from_live is None:
        return OdometryStatus.NO_CONSENSUS
    return OdometryStatus.TOO_FEW_MATCHES
