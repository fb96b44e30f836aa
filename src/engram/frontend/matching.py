"""Frame ↔ frame: matched landmarks and the relative pose, also between different cameras.

`match_frames` is a pure function: the same frames, configuration, seed and prediction give the same
`Match`, to the bit, on every machine. Not finding a pose is a result, not an error.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated
from uuid import UUID

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram import _core
from engram.config import check_bounds, config_hash
from engram.errors import IncompatibleError, InputError
from engram.frontend.frame import Frame
from engram.geometry.se3 import SE3

# Part of `matcher_hash`: raise it when the kernels give different results for equal settings.
_VERSION = 4


@dataclass(frozen=True, slots=True)
class MatcherConfig:
    """Settings of `match_frames`.

    Attributes:
        max_distance: largest number of different bits of two descriptors, searching the whole
            frame. Two random descriptors of 256 bits differ in 128 ± 8; the least of 500 differs
            in about 100.
        max_guided_distance: the same near a predicted pixel, where few candidates compete.
        ratio: the best distance must be less than this times the next best (Lowe 2004).
        guided_ratio: the same near a predicted pixel.
        same_corner_px: a candidate this close to the best one is the same corner in another
            octave, not a rival.
        octave_scale: size ratio of successive octaves of the front-end.
        patch_ratio: largest ratio of the metric sizes of two compared patches (method §2.6). BRIEF
            tolerates a change of scale of about 1.5; the rest allows for slanted surfaces. Depth
            uncertainty widens it.
        pixel_sigma_px: standard deviation of a corner's pixel at full resolution, one axis, between
            views 0.4 to 2 m apart; it grows with the square root of the octave's scale. Source:
            EuRoC and KITTI, 0.65 and 0.9 px.
        disparity_sigma_px: error that sub-pixel interpolation and slanted surfaces add to a
            disparity's own σ between views. Source: as `pixel_sigma_px`.
        offset_sigma_px: standard deviation of the common offset of a camera's disparities:
            rectification is good to a few tenths of a pixel, and its error does not average out.
            The offset is estimated with the pose, and its uncertainty is part of the covariance.
        offset_drift_px: standard deviation of that offset between two frames of one camera.
        gate_sigmas: standard deviations that gates and search windows span.
        max_radius_px: largest radius of a search window, whatever the prediction's covariance.
        chi2: largest squared normalised reprojection error of an inlier: 99 % of χ² with the
            three degrees of freedom of left u, left v and disparity.
        independent_landmarks: a second pass searches as wide as if landmarks beyond this number
            shared their errors. Source: motion capture of EuRoC.
        few_inliers: variances of a pose grow by the square of this over its number of inliers: of
            few, a large share agrees by chance. Source: `lab/reports/trust.md`, as the next two.
        displaced_m: standard deviation of a position, each axis, times the number of inliers: edges
            of shadows move with the sun.
        offset_doubt: variances grow by the square of this times χ² of the offsets that fit best: a
            wrong pose on far landmarks needs large ones.
        calibration_share, calibration_m, calibration_rad: what calibration leaves: standard
            deviations of a position, each axis, per metre between the cameras and at any distance,
            and of the rotation. Source: KITTI; motion capture of EuRoC.
        min_consensus: fewest landmarks of a pose; any three agree on some pose. The localiser
            accepts a match by a higher threshold.
        confidence: stop drawing once a better pose is less likely than one minus this.
        max_view_angle_rad: largest angle between the optical axes of a valid pose: the view gate of
            method §3.1 with a margin. Beyond it images overlap only at their edges.
        second_pass: search once more, guided by the pose found.
    """

    max_distance: Annotated[int, Meta(ge=0)] = 80
    max_guided_distance: Annotated[int, Meta(ge=0)] = 90
    ratio: Annotated[float, Meta(gt=0, lt=1)] = 0.85
    guided_ratio: Annotated[float, Meta(gt=0, lt=1)] = 0.9
    same_corner_px: float = 3.0
    octave_scale: Annotated[float, Meta(ge=1, le=100)] = 2.0
    patch_ratio: Annotated[float, Meta(ge=1, le=100)] = 2.0
    pixel_sigma_px: Annotated[float, Meta(gt=0)] = 0.65
    disparity_sigma_px: Annotated[float, Meta(gt=0)] = 0.08
    offset_sigma_px: Annotated[float, Meta(gt=0)] = 0.3
    offset_drift_px: Annotated[float, Meta(gt=0)] = 0.02
    gate_sigmas: Annotated[float, Meta(gt=0)] = 3.0
    max_radius_px: Annotated[float, Meta(gt=0)] = 128.0
    chi2: Annotated[float, Meta(gt=0)] = 11.34
    independent_landmarks: Annotated[float, Meta(gt=0)] = 10.0
    few_inliers: Annotated[float, Meta(ge=0)] = 25.0
    displaced_m: Annotated[float, Meta(ge=0)] = 2.0
    offset_doubt: Annotated[float, Meta(ge=0)] = 1.0
    calibration_share: Annotated[float, Meta(ge=0)] = 0.005
    calibration_m: Annotated[float, Meta(ge=0)] = 0.01
    calibration_rad: Annotated[float, Meta(ge=0)] = 0.001
    min_consensus: Annotated[int, Meta(ge=4)] = 6
    max_samples: Annotated[
        int,
        Meta(
            ge=1,
            description="most triples of matches aligned; bounds the cost of a failed attempt. "
            "Source: lab/reports/performance.md",
        ),
    ] = 512
    max_hypotheses: Annotated[int, Meta(ge=1, description="most of them refined")] = 250
    min_followers: Annotated[
        int,
        Meta(
            ge=0,
            description="matches that must follow an aligned triple, its own three among them, "
            "for it to be refined",
        ),
    ] = 5
    glance_share: Annotated[
        int,
        Meta(
            ge=1,
            description="without a prediction, one landmark in so many is compared first; 1 "
            "compares all at once",
        ),
    ] = 4
    glance_samples: Annotated[
        int, Meta(ge=1, description="as max_samples, among the matches of these")
    ] = 48
    glance_consensus: Annotated[
        int,
        Meta(ge=4, description="of these must agree on a pose for it to guide the search for all"),
    ] = 20
    glance_inliers: Annotated[
        int,
        Meta(
            ge=4,
            description="and all must find so many inliers, three times what look-alike places "
            "reach; else the other landmarks are compared, too",
        ),
    ] = 96
    confidence: Annotated[float, Meta(gt=0, lt=1)] = 0.999
    max_view_angle_rad: float = 1.2
    second_pass: bool = True

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """The result of matching two frames.

    Attributes:
        reference_from_live: pose of the live camera in the reference camera; None if too few
            landmarks agree on one.
        covariance: (6, 6) float64 of `reference_from_live`, left perturbation, [translation,
            rotation]; None without it.
        inliers: number of landmarks that agree, 0 without a pose.
        reference_rows, live_rows: (inliers,) int32, rows of the landmarks that agree.
    """

    reference_from_live: SE3 | None
    covariance: NDArray[np.float64] | None
    inliers: int
    reference_rows: NDArray[np.int32]
    live_rows: NDArray[np.int32]


NO_MATCH = Match(None, None, 0, np.empty(0, dtype=np.int32), np.empty(0, dtype=np.int32))


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """What a live frame is matched with: the arguments of `match_frames`.

    Attributes:
        predicted_covariance: (6, 6) float64 of `predicted`, left perturbation, [translation m,
            rotation rad].
    """

    reference: Frame
    config: MatcherConfig
    seed: int
    predicted: SE3 | None = None
    predicted_covariance: NDArray[np.float64] | None = None


def match_frames(
    reference: Frame,
    live: Frame,
    config: MatcherConfig,
    seed: int,
    predicted: SE3 | None = None,
    predicted_covariance: NDArray[np.float64] | None = None,
) -> Match:
    """Match the landmarks of two frames and estimate the pose between them.

    Args:
        reference: the reference frame; its camera may differ from the live one.
        seed: seed of the random draws, 0 … 2⁶⁴ − 1; see `pair_seed`.
        predicted: predicted reference_from_live; only landmarks near their predicted pixels are
            then compared. None to search the whole frame.
        predicted_covariance: (6, 6) float64 of `predicted`, left perturbation, [translation,
            rotation]; required with it.

    Source: method §2.4–2.6.
    """
    question = Question(reference, config, seed, predicted, predicted_covariance)
    return match_of(_core.attempt(features(live), [arguments(question, live)])[0])


def arguments(asked: Question, live: Frame) -> _core.AttemptArguments:
    """A question in the form of the kernels.

    Raises:
        IncompatibleError, InputError: as `match_frames`.
    """
    check_same_kind(asked.reference, live)
    predicted, covariance = asked.predicted, asked.predicted_covariance
    if (predicted is None) != (covariance is None):
        raise InputError("give a prediction and its covariance together or not at all")
    return (
        features(asked.reference),
        core_settings(asked.config, same_camera=asked.reference.camera == live.camera),
        asked.seed,
        None if predicted is None else predicted.matrix(),
        None if covariance is None else np.ascontiguousarray(covariance),
    )


def match_of(found: _core.PoseAndInliers | None) -> Match:
    """The match that the kernels found."""
    if found is None:
        return NO_MATCH
    matrix, covariance, reference_rows, live_rows = found
    # Refinement multiplies many small updates in single precision: 1e-6 of skew.
    pose = SE3(matrix[:3, :3], matrix[:3, 3]).renormalised()
    return Match(pose, covariance, len(live_rows), reference_rows, live_rows)


def matcher_hash(config: MatcherConfig) -> str:
    """Twelve hexadecimal digits that change with any setting and with the method's version."""
    return hashlib.sha256(f"{_VERSION} {config_hash(config)}".encode()).hexdigest()[:12]


def pair_seed(a: UUID, b: UUID) -> int:
    """The seed for matching two frames, from their UUIDs (method §3.2); (b, a) gives another."""
    digest = hashlib.blake2b(a.bytes + b.bytes, digest_size=8).digest()
    return int.from_bytes(digest, "little")


def features(frame: Frame) -> _core.Features:
    """The landmarks of a frame in the form of the kernels, without a copy."""
    landmarks, camera = frame.landmarks, frame.camera
    return _core.Features(
        landmarks.pixels,
        landmarks.disparity_px,
        landmarks.disparity_sigma_px,
        landmarks.points_in_cam,
        landmarks.descriptors,
        landmarks.octaves,
        (camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline_m),
    )


def check_same_kind(reference: Frame, live: Frame) -> None:
    """Refuses two frames whose descriptors cannot be compared."""
    if reference.descriptor != live.descriptor:
        raise IncompatibleError(
            f"cannot match {live.descriptor} descriptors with {reference.descriptor}: "
            "use the front-end that the map was made with"
        )


@lru_cache(maxsize=16)
def core_settings(config: MatcherConfig, *, same_camera: bool = False) -> _core.MatchSettings:
    """The settings in the form of the kernels; for frames of one camera if `same_camera`."""
    settings = _core.MatchSettings()
    values = {name: getattr(config, name) for name in MatcherConfig.__dataclass_fields__}
    values["max_view_angle_cosine"] = math.cos(values.pop("max_view_angle_rad"))
    for name, value in values.items():
        setattr(settings, name, value)
    settings.same_camera = same_camera
    return settings
