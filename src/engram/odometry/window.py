"""The last few keyframes with the landmarks they share, optimised together [G16 §III-A]."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.errors import ConfigError
from engram.frontend import Frame, Match, MatcherConfig
from engram.geometry import SE3

_UNSEEN = -1


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """Settings of the joint optimisation.

    Attributes:
        frames: frames optimised together, including the newest. More than seven gain little.
        landmarks: most landmarks, longest tracks first; bounds the time.
        iterations: most iterations; one or two usually suffice. 0 skips the optimisation.
        offset_sigma_px: standard deviation of the change of a rectified camera's disparity offset
            between successive windows. Each window starts from the last estimate, which converges
            within about ten frames.
    """

    frames: int = 7
    landmarks: int = 500
    iterations: int = 5
    offset_sigma_px: float = 0.1

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise ConfigError(f"window: frames is {self.frames}, must be ≥ 2")
        for name, least in (("landmarks", 1), ("iterations", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"window: {name} is {getattr(self, name)}, must be ≥ {least}")


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

    def __init__(
        self, first: Frame, config: WindowConfig, matcher: MatcherConfig, offset_px: float = 0.0
    ) -> None:
        self._config = config
        self._matcher = matcher
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

    def optimise(self, match: Match) -> tuple[SE3, NDArray[np.float64]]:
        """Adjust all poses but the oldest, and all landmarks.

        Returns:
            keyframe_from_newest and its (6, 6) float64 covariance; those of `match` if the
            landmarks do not determine the window.

        Source: SPEC §2.4.
        """
        assert self._newest is not None
        assert match.reference_from_live is not None
        assert match.covariance is not None
        placed = [*self._keyframes, self._newest]
        adjusted = self._adjust(placed) if self._config.iterations else None
        if adjusted is None:
            return match.reference_from_live, match.covariance
        matrices, covariance, self._offset_px = adjusted
        moved = [
            replace(each, world_from_cam=SE3(matrix[:3, :3], matrix[:3, 3]))
            for each, matrix in zip(placed, matrices, strict=True)
        ]
        self._keyframes, self._newest = moved[:-1], moved[-1]
        # As in a match: landmarks share errors, which do not average out.
        shared = 1 + match.inliers / self._matcher.independent_landmarks
        keyframe_from_world = moved[-2].world_from_cam.inverse()
        carry = keyframe_from_world.adjoint()
        return (
            keyframe_from_world @ moved[-1].world_from_cam,
            shared * carry @ _covariance_of_last_step(covariance) @ carry.T,
        )

    def _place(self, frame: Frame, world_from_cam: SE3) -> _Placed:
        marks = frame.landmarks
        growth = np.sqrt(self._matcher.octave_scale) ** marks.octaves.astype(np.float32)
        return _Placed(
            frame,
            world_from_cam,
            tracks=np.full(len(marks), _UNSEEN, dtype=np.int32),
            stereo=np.column_stack([marks.pixels, marks.disparity_px]),
            pixel_sigma_px=(self._matcher.pixel_sigma_px * growth).astype(np.float32),
            disparity_sigma_px=np.hypot(
                marks.disparity_sigma_px, np.float32(self._matcher.disparity_sigma_px)
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
