"""Twin of the core's odometry: the same steps in NumPy, over the core's match and window."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.frontend.frame import Frame, FrameStatus
from engram.frontend.matching import Match, match_frames
from engram.geometry.se3 import SE3, propagate_covariance
from engram.odometry.odometry import OdometryConfig
from engram.odometry.step import Guess, OdometryStatus, OdometryStep

_S_PER_NS = 1e-9
# Steps that determine the usual number of inliers and the usual interval.
_USUAL_OF = 20
# Frames are missing if one comes later than this many usual intervals after the last.
_GAP_RATIO = 1.5
# A motion nearer than this to the last speed goes on as before.
_STEADY_SIGMAS = 2.0
# A robot that lost this share of its speed has stopped; a step vaguer than that tells no speed.
_STOPPED_SHARE = 0.5
_UNSEEN = -1


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """A frame with its estimated pose.

    Attributes:
        frame: the frame.
        world_from_cam: its pose in the window's world.
        tracks: (N,) int32, the track of each landmark, `_UNSEEN` if no other frame shares it.
        stereo: (N, 3) float32, left u, left v, disparity, px.
        pixel_sigma_px, disparity_sigma_px: (N,) float32, between views.
    """

    frame: Frame
    world_from_cam: SE3
    tracks: NDArray[np.int32]
    stereo: NDArray[np.float32]
    pixel_sigma_px: NDArray[np.float32]
    disparity_sigma_px: NDArray[np.float32]


class Window:
    """Keyframes and the newest frame, with poses in the camera of the window's first frame.

    The oldest pose is fixed, the others move. The next frame replaces the newest one unless
    `keep_newest` was called, so that the window spans motion, not time.
    """

    def __init__(self, first: Frame, config: OdometryConfig, offset_px: float = 0.0) -> None:
        self._config = config.window
        self._matcher = config.matcher
        self._few_inliers = config.few_inliers
        self._keyframes = [self._place(first, SE3.identity())]
        self._newest: _Placed | None = None
        self._next_track = 0
        self._offset_px = offset_px

    @property
    def offset_px(self) -> float:
        """Estimated excess of the camera's disparities, px."""
        return self._offset_px

    @property
    def keyframe(self) -> Frame:
        """The newest keyframe, to which the next frame is matched."""
        return self._keyframes[-1].frame

    @property
    def has_newest(self) -> bool:
        """Whether the newest frame is not a keyframe."""
        return self._newest is not None

    def add(self, frame: Frame, match: Match) -> None:
        """Replace the newest frame by one that was matched to `keyframe`."""
        assert match.reference_from_live is not None
        key = self._keyframes[-1]
        tracks = key.tracks.copy()
        fresh = match.reference_rows[tracks[match.reference_rows] == _UNSEEN]
        tracks[fresh] = np.arange(self._next_track, self._next_track + len(fresh), dtype=np.int32)
        self._next_track += len(fresh)
        self._keyframes[-1] = replace(key, tracks=tracks)
        self._newest = self._place(frame, key.world_from_cam @ match.reference_from_live)
        self._newest.tracks[match.live_rows] = tracks[match.reference_rows]

    def keep_newest(self) -> None:
        """Make the newest frame a keyframe; the oldest one leaves when the window is full."""
        assert self._newest is not None
        self._keyframes = [*self._keyframes, self._newest][-(self._config.frames - 1) :]
        self._newest = None

    def optimise(self, match: Match) -> tuple[SE3, NDArray[np.float64], NDArray[np.float64]]:
        """Adjust all poses but the oldest, and all landmarks.

        Returns:
            keyframe_from_newest, its (6, 6) float64 covariance, and the same as wide as matching
            searches; those of `match` if the landmarks do not determine the window.

        Source: method §2.4.
        """
        assert self._newest is not None
        assert match.reference_from_live is not None
        assert match.covariance is not None
        placed = [*self._keyframes, self._newest]
        adjusted = self._adjust(placed) if self._config.iterations else None
        if adjusted is None:
            return match.reference_from_live, match.covariance, match.covariance
        matrices, covariance, self._offset_px = adjusted
        moved = [
            replace(each, world_from_cam=SE3(matrix[:3, :3], matrix[:3, 3]))
            for each, matrix in zip(placed, matrices, strict=True)
        ]
        self._keyframes, self._newest = moved[:-1], moved[-1]
        keyframe_from_world = moved[-2].world_from_cam.inverse()
        carry = keyframe_from_world.adjoint()
        keyframe_from_newest = keyframe_from_world @ moved[-1].world_from_cam
        by_residuals = carry @ _covariance_of_last_step(covariance) @ carry.T
        wider = 1 + match.inliers / self._matcher.independent_landmarks
        growth = 1 + (self._few_inliers / match.inliers) ** 2
        return keyframe_from_newest, growth * by_residuals, wider * by_residuals

    def _place(self, frame: Frame, world_from_cam: SE3) -> _Placed:
        marks = frame.landmarks
        growth = np.sqrt(self._matcher.octave_scale) ** marks.octaves.astype(np.float32)
        return _Placed(
            frame,
            world_from_cam,
            tracks=np.full(len(marks), _UNSEEN, dtype=np.int32),
            stereo=np.column_stack([marks.pixels, marks.disparity_px]),
            pixel_sigma_px=(self._config.pixel_sigma_px * growth).astype(np.float32),
            disparity_sigma_px=np.hypot(
                marks.disparity_sigma_px, np.float32(self._config.disparity_sigma_px)
            ),
        )

    def _adjust(
        self, placed: list[_Placed]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float] | None:
        track = np.concatenate([each.tracks for each in placed])
        used = np.flatnonzero(track != _UNSEEN)
        numbered = _number_longest(track[used], self._config.landmarks)
        used, numbered = used[numbered != _UNSEEN], numbered[numbered != _UNSEEN]
        sizes = [len(each.tracks) for each in placed]
        frame_of = np.repeat(np.arange(len(placed), dtype=np.int32), sizes)
        camera = placed[-1].frame.camera
        adjusted = _core.adjust_window(
            (camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline_m),
            np.array([each.world_from_cam.matrix() for each in placed]),
            frame_of[used],
            numbered,
            np.concatenate([each.stereo for each in placed])[used],
            np.concatenate([each.pixel_sigma_px for each in placed])[used],
            np.concatenate([each.disparity_sigma_px for each in placed])[used],
            fixed=1,
            iterations=self._config.iterations,
            chi2=self._matcher.chi2,
            offset_px=self._offset_px,
            offset_sigma_px=self._config.offset_sigma_px,
        )
        return None if adjusted is None else (adjusted[0], adjusted[1], adjusted[3])


def _number_longest(track: NDArray[np.int32], most: int) -> NDArray[np.int32]:
    """Number the tracks from 0; `_UNSEEN` for those seen once and, beyond `most`, the shortest."""
    if len(track) == 0:
        return track
    # By what lives, not by span: a landmark always in sight keeps its first number for hours.
    living, place = np.unique(track, return_inverse=True)
    length = np.bincount(place, minlength=len(living))
    # Lengths are at most the frames of the window; 16 bits are sorted by radix, 64 by merging.
    shortness = (length.max() - length).astype(np.uint16)
    kept = np.argsort(shortness, kind="stable")[:most]
    kept = kept[length[kept] >= 2]
    number = np.full(len(length), _UNSEEN, dtype=np.int32)
    number[kept] = np.arange(len(kept), dtype=np.int32)
    return np.asarray(number[place])


def _covariance_of_last_step(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance, in the world, of the last pose relative to the one before it.

    The last block belongs to the newest frame; without a block before it the keyframe is held.
    """
    newest = covariance[-6:, -6:]
    if len(covariance) == 6:
        return newest
    key, cross = covariance[-12:-6, -12:-6], covariance[-12:-6, -6:]
    return newest + key - cross - cross.T


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

        Source: method §2.4; [G16] §III-A.
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
        return self._track.advance(frame, match, *self._track.place(frame, match))

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
        self._window = Window(first, config, offset_px)
        self.stamp_ns = first.stamp_ns
        self._keyframe_from_prev = SE3.identity()
        self._covariance = np.zeros((6, 6))  # of keyframe_from_prev
        self._searched = np.zeros((6, 6))  # the same, as wide as matching searches
        self._velocity: NDArray[np.float64] | None = None  # (6,) tangent per second
        # Of the last step that was neither vague nor an impossible stop, with its length, m, and
        # its frame's stamp.
        self._believed: tuple[NDArray[np.float64], float, int] | None = None
        self._stopped = False

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
        """Match to the keyframe; if that fails or stops at once, to the previous frame."""
        match = self._match_to_keyframe(frame, expected)
        fails = match.inliers < self._config.min_inliers
        if match.reference_from_live is not None:
            moved = self._keyframe_from_prev.inverse() @ match.reference_from_live
            fails = fails or self._stops_at_once(moved, frame.stamp_ns)
        if fails and self._window.has_newest:
            self._keep_previous_as_keyframe()
            match = self._match_to_keyframe(frame, expected)
        return match

    def place(
        self, frame: Frame, match: Match
    ) -> tuple[SE3, NDArray[np.float64], NDArray[np.float64]]:
        """keyframe_from_curr after joint optimisation; see `Window.optimise`."""
        self._window.add(frame, match)
        return self._window.optimise(match)

    def advance(
        self,
        frame: Frame,
        match: Match,
        keyframe_from_curr: SE3,
        covariance: NDArray[np.float64],
        searched: NDArray[np.float64],
    ) -> OdometryStep:
        """Make the frame the previous one; returns the motion that led to it.

        Args:
            frame: the frame.
            match: its match to the keyframe.
            keyframe_from_curr: its pose in the keyframe.
            covariance: (6, 6) float64 of that pose, left perturbation, [translation, rotation].
            searched: (6, 6) float64, the same, as wide as matching searches.
        """
        prev_from_keyframe = self._keyframe_from_prev.inverse()
        prev_from_curr = prev_from_keyframe @ keyframe_from_curr
        carry = prev_from_keyframe.adjoint()
        left_m = self._config.matcher.calibration_share * prev_from_curr.distance_m
        step = OdometryStep(
            OdometryStatus.OK,
            prev_from_curr,
            carry @ (self._covariance + covariance) @ carry.T
            + np.diag([left_m**2] * 3 + [0.0] * 3),
            match.inliers,
        )
        interval_s = (frame.stamp_ns - self.stamp_ns) * _S_PER_NS
        self._velocity = prev_from_curr.log() / interval_s if interval_s > 0 else None
        stops = self._stops_at_once(prev_from_curr, frame.stamp_ns)
        assert step.covariance is not None
        sigma_m, step_m = float(np.sqrt(np.trace(step.covariance[:3, :3]))), step.moved_m
        if stops:
            assert self._believed is not None
            self._stopped = True
            further_m = self._believed[0][:3] * interval_s - prev_from_curr.translation
            step.covariance[:3, :3] += np.outer(further_m, further_m)
        elif self._velocity is not None and sigma_m <= _STOPPED_SHARE * step_m:
            self._believed, self._stopped = (self._velocity, step_m, frame.stamp_ns), False
        elif self._velocity is None or not self._counts(frame.stamp_ns):
            self._believed, self._stopped = None, False
        self.stamp_ns = frame.stamp_ns
        self._keyframe_from_prev, self._covariance = keyframe_from_curr, covariance
        self._searched = searched
        if stops:
            self._window = Window(frame, self._config, self.offset_px)
            self._begin_at_previous()
        elif self._has_moved_on(frame, match):
            self._keep_previous_as_keyframe()
        return step

    def _stops_at_once(self, prev_from_curr: SE3, stamp_ns: int) -> bool:
        """Whether a step is, or goes on with, a stop faster than any robot brakes."""
        interval_s = (stamp_ns - self.stamp_ns) * _S_PER_NS
        if interval_s <= 0 or self._believed is None or not self._counts(stamp_ns):
            return False
        velocity, step_m, believed_ns = self._believed
        speed_m_s = float(np.linalg.norm(velocity[:3]))
        was_m_s = min(speed_m_s, step_m / interval_s)
        along = velocity[:3] / max(speed_m_s, 1e-9)
        lost_m_s = was_m_s - float(prev_from_curr.log()[:3] @ along) / interval_s
        since_s = (stamp_ns - believed_ns) * _S_PER_NS
        braked_m_s = 0.0 if self._stopped else self._config.braking_m_s2 * since_s
        return lost_m_s > max(_STOPPED_SHARE * was_m_s, braked_m_s)

    def _counts(self, stamp_ns: int) -> bool:
        """Whether the believed speed is recent."""
        if self._believed is None:
            return False
        return (stamp_ns - self._believed[2]) * _S_PER_NS <= self._config.disbelief_s

    def _match_to_keyframe(self, frame: Frame, expected: Guess | None) -> Match:
        """Guided by constant velocity or what is expected; if that fails, unguided."""
        key, matcher = self._window.keyframe, self._config.matcher
        seed = frame.stamp_ns % 2**64
        prediction = self._predict(frame, expected)
        if prediction is not None:
            match = match_frames(key, frame, matcher, seed, *prediction)
            match = self._or_steady(frame, match)
            if match.inliers >= self._config.min_inliers:
                return match
        return match_frames(key, frame, matcher, seed)

    def _predict(
        self, frame: Frame, expected: Guess | None
    ) -> tuple[SE3, NDArray[np.float64]] | None:
        interval_s = (frame.stamp_ns - self.stamp_ns) * _S_PER_NS
        if not self._knows_speed(interval_s):
            if expected is None or not expected.has_way:
                return None
            return (
                self._keyframe_from_prev @ expected.prev_from_curr,
                propagate_covariance(self._keyframe_from_prev, self._searched, expected.covariance),
            )
        square = interval_s**2
        assert self._velocity is not None
        return self._by_speed(
            self._velocity,
            interval_s,
            self._config.acceleration_m_s2 * square,
            self._config.angular_acceleration_rad_s2 * square,
        )

    def _knows_speed(self, interval_s: float) -> bool:
        return self._velocity is not None and 0 < interval_s <= self._config.max_prediction_s

    def _by_speed(
        self,
        velocity: NDArray[np.float64],
        interval_s: float,
        sigma_m: float,
        sigma_rad: float,
    ) -> tuple[SE3, NDArray[np.float64]]:
        noise = np.diag(np.repeat([sigma_m, sigma_rad], 3) ** 2)
        return (
            self._keyframe_from_prev @ SE3.exp(velocity * interval_s),
            propagate_covariance(self._keyframe_from_prev, self._searched, noise),
        )

    def _or_steady(self, frame: Frame, match: Match) -> Match:
        """A match, or that at the last speed where enough landmarks agree on it, too."""
        config, interval_s = self._config, (frame.stamp_ns - self.stamp_ns) * _S_PER_NS
        if match.reference_from_live is None or not self._knows_speed(interval_s):
            return match
        assert self._velocity is not None
        velocity = self._velocity
        if self._stopped:
            assert self._believed is not None
            velocity = self._believed[0]
        steady = self._by_speed(velocity, interval_s, config.steady_m, config.steady_rad)
        away = _sigmas_away(steady, match)
        if away <= _STEADY_SIGMAS:
            return match
        seed = frame.stamp_ns % 2**64
        again = match_frames(self._window.keyframe, frame, config.matcher, seed, *steady)
        moved = self._keyframe_from_prev.inverse() @ match.reference_from_live
        stops = self._stops_at_once(moved, frame.stamp_ns)
        share = config.braking_share if stops else config.steady_share
        enough = again.inliers >= max(share * match.inliers, config.min_inliers)
        return again if enough and _sigmas_away(steady, again) < away else match

    def _keep_previous_as_keyframe(self) -> None:
        self._window.keep_newest()
        self._begin_at_previous()

    def _begin_at_previous(self) -> None:
        self._keyframe_from_prev = SE3.identity()
        self._covariance, self._searched = np.zeros((6, 6)), np.zeros((6, 6))

    def _has_moved_on(self, frame: Frame, match: Match) -> bool:
        before = self._window.keyframe.landmarks
        if match.inliers < self._config.keyframe_share * min(len(before), len(frame.landmarks)):
            return True
        flow = frame.landmarks.pixels[match.live_rows] - before.pixels[match.reference_rows]
        return bool(np.median(np.abs(flow).max(axis=1)) > self._config.keyframe_flow_px)


def _sigmas_away(prediction: tuple[SE3, NDArray[np.float64]], match: Match) -> float:
    predicted, covariance = prediction
    assert match.reference_from_live is not None
    off = (match.reference_from_live @ predicted.inverse()).log()
    return float((np.abs(off) / np.sqrt(np.diag(covariance))).max())


def _reason(match: Match) -> OdometryStatus:
    if match.reference_from_live is None:
        return OdometryStatus.NO_CONSENSUS
    return OdometryStatus.TOO_FEW_MATCHES
