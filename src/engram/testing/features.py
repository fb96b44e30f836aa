"""What every kind of features must do, checked on a wall that moves past the camera."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend.features import FeatureKind, fitted_matcher
from engram.frontend.frame import BRIEF, Frame, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry import StereoCamera
from engram.testing.checks import Check

_CAMERA = StereoCamera(260.0, 260.0, 160.0, 120.0, 0.2, 320, 240)
_STEP_PX, _DISPARITY_PX = 12, 12
_STEP_M = _CAMERA.baseline_m * _STEP_PX / _DISPARITY_PX
_WITHIN_M = 0.02
# Less and all corners look alike.
_LEAST_DIFFERENT = 0.25
_FEWEST_INLIERS = 100


def check_kind(kind: FeatureKind) -> list[Check]:
    """Runs a kind that stands in `FEATURES` on synthetic pairs; a second at most."""
    frontend = Frontend(FrontendConfig(descriptor=kind.name, thumbnails=False))
    first, again = (frontend.extract(_pair(0, 0)) for _ in range(2))
    ahead = frontend.extract(_pair(1, 1))
    landmarks = first.landmarks
    shape = (len(landmarks), kind.descriptor_bytes)
    same = np.array_equal(landmarks.descriptors, again.landmarks.descriptors)
    described = kind.describe(_pair(0, 0).left, landmarks.pixels, landmarks.octaves)
    differ = float(np.bitwise_count(described ^ landmarks.descriptors).mean()) / 8
    return [
        Check(
            f"descriptors are (N, {kind.descriptor_bytes}) uint8",
            landmarks.descriptors.shape == shape and landmarks.descriptors.dtype == np.uint8,
            f"{landmarks.descriptors.shape} {landmarks.descriptors.dtype}",
        ),
        Check("equal images give equal bits", same, "equal" if same else "different"),
        Check(
            "describing the corners again gives the same bits but for 2 %",
            differ < 0.02,
            f"{100 * differ:.1f} % differ",
        ),
        _spread(landmarks.descriptors),
        _motion(kind, first, ahead),
    ]


def _spread(descriptors: NDArray[np.uint8]) -> Check:
    half = len(descriptors) // 2
    share = float(np.bitwise_count(descriptors[:half] ^ descriptors[-half:]).mean()) / 8
    return Check(
        f"different corners differ in {100 * _LEAST_DIFFERENT:.0f} % of the bits",
        share >= _LEAST_DIFFERENT,
        f"{100 * share:.0f} %",
    )


def _motion(kind: FeatureKind, reference: Frame, live: Frame) -> Check:
    config = fitted_matcher(MatcherConfig(), BRIEF, kind.name)
    match = match_frames(reference, live, config, seed=1)
    demand = f"{_FEWEST_INLIERS} landmarks agree on a motion, accurate to {1000 * _WITHIN_M:.0f} mm"
    if match.reference_from_live is None:
        return Check(demand, False, "no motion")
    off = match.reference_from_live.translation - np.array([_STEP_M, 0, 0])
    off_m = float(np.linalg.norm(off))
    met = match.inliers >= _FEWEST_INLIERS and off_m < _WITHIN_M
    return Check(demand, met, f"{match.inliers} landmarks, {1000 * off_m:.0f} mm off")


def _pair(index: int, noise: int) -> StereoPair:
    """What a camera sees that drives along the wall; grey levels of noise."""
    draws = np.random.default_rng([noise, index])
    views = []
    for start in (_STEP_PX * index, _STEP_PX * index + _DISPARITY_PX):
        view = _wall()[:, start : start + 320] + draws.normal(0, 3 * noise, (240, 320))
        views.append(np.ascontiguousarray(np.clip(np.rint(view), 0, 255).astype(np.uint8)))
    return StereoPair(index + 1, views[0], views[1], _CAMERA)


def _wall() -> NDArray[np.float32]:
    draws, total = np.random.default_rng(5), np.zeros((240, 360), np.float32)
    for sigma in (1.0, 2.0, 5.0):
        layer = cv2.GaussianBlur(draws.standard_normal((240, 360), np.float32), (0, 0), sigma)
        total += layer / layer.std()
    return 128 + 30 * total
