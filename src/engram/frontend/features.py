"""The kinds of features: how landmarks are detected and described, in one table.

All other code takes the width of a descriptor from this table. Another package adds a kind by an
entry point of the group `engram.features` that names a `FeatureKind`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.errors import ConfigError, IncompatibleError
from engram.frontend import network
from engram.frontend.frame import BRIEF, TEBLID, DescriptorKind, StereoPair
from engram.frontend.matching import MatcherConfig
from engram.frontend.opencv_contrib import xfeatures2d
from engram.plugins import PluginGroup, check_is

if TYPE_CHECKING:
    from engram.frontend.frontend import FrontendConfig

NET = DescriptorKind(f"net@{network.MODEL}")

# OpenCV's TEBLID takes the patch from keypoint size × scale factor; 7 and 5 suit corners without a
# size best.
_TEBLID_SCALE_FACTOR = 5.0
_TEBLID_KEYPOINT_SIZE_PX = 7.0


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """Detected landmarks of a stereo pair, before quantisation.

    Attributes:
        pixels: (N, 2) float32, left u, v, px.
        disparity_px: (N,) float32, > 0.
        sigma_px: (N,) float32, standard deviation of the disparity.
        octaves: (N,) uint8, pyramid level of detection, 0 is full resolution.
        candidates: number of points of the left image whose disparity was searched.
        descriptors: (N, B) uint8 if the detector also describes, else None.
    """

    pixels: NDArray[np.float32]
    disparity_px: NDArray[np.float32]
    sigma_px: NDArray[np.float32]
    octaves: NDArray[np.uint8]
    candidates: int
    descriptors: NDArray[np.uint8] | None = None


class Detect(Protocol):
    """Finds landmarks in a stereo pair."""

    def __call__(self, pair: StereoPair, config: FrontendConfig, landmarks: int) -> Keypoints:
        """At most `landmarks` keypoints of a pair with checked images."""
        ...


class Describe(Protocol):
    """Describes points of an image."""

    def __call__(
        self, image: NDArray[np.uint8], pixels: NDArray[np.float32], octaves: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        """Descriptors (N, B) uint8, B as the kind's `descriptor_bytes`.

        Args:
            image: (h, w) uint8 grey.
            pixels: (N, 2) float32 u, v, px of the full-size image.
            octaves: (N,) uint8, pyramid level of each point; each level is half the size of the
                previous one.
        """
        ...


@dataclass(frozen=True, slots=True)
class FeatureKind:
    """One kind of feature: binary descriptors, compared by the number of different bits.

    Attributes:
        name: its name in maps and frame logs; `NAME@MODEL` where a learned model describes, MODEL
            being a hash of its weights. Settings and commands may leave out the model.
        descriptor_bytes: width of a descriptor, a multiple of 8 up to 2048.
        detect: finds the landmarks.
        describe: describes them, if `detect` does not.
        matcher: suitable matcher settings; they replace those left at their defaults.
        good_at: what to choose it for, in a few words.
    """

    name: DescriptorKind
    descriptor_bytes: int
    detect: Detect
    describe: Describe
    matcher: MatcherConfig = field(default_factory=MatcherConfig)
    good_at: str = ""

    def __post_init__(self) -> None:
        if not (0 < self.descriptor_bytes <= 2048 and self.descriptor_bytes % 8 == 0):
            raise IncompatibleError(
                f"feature kind {self.name!r} has descriptors of {self.descriptor_bytes} bytes, "
                "must be a multiple of 8 up to 2048"
            )


def detect_corners(pair: StereoPair, config: FrontendConfig, landmarks: int) -> Keypoints:
    """FAST corners with a disparity, the best of each cell of a grid first (method §2.1–2.3)."""
    return _corners(pair, config, landmarks, with_brief=False)


def detect_corners_with_brief(
    pair: StereoPair, config: FrontendConfig, landmarks: int
) -> Keypoints:
    """`detect_corners` and `describe_brief` in one pass."""
    return _corners(pair, config, landmarks, with_brief=True)


def _corners(
    pair: StereoPair, config: FrontendConfig, landmarks: int, *, with_brief: bool
) -> Keypoints:
    pixels, disparity_px, sigma_px, descriptors, octaves, corners = _core.extract(
        pair.left,
        pair.right,
        landmarks=landmarks,
        octaves=config.octaves,
        fast_threshold=config.fast_threshold,
        cell_px=config.cell_px,
        with_descriptors=with_brief,
        max_disparity_px=config.max_disparity_px,
        min_disparity_px=config.min_disparity_px,
        uniqueness=config.uniqueness,
        max_residual=config.max_residual,
        max_sigma_px=config.max_sigma_px,
        sigma_floor_px=config.sigma_floor_px,
        sigma_scale=config.sigma_scale,
        second_threshold=config.second_threshold,
        side_difference=config.side_difference,
        mask=pair.mask,
    )
    described = descriptors if with_brief else None
    return Keypoints(pixels, disparity_px, sigma_px, octaves, corners, described)


def describe_brief(
    image: NDArray[np.uint8], pixels: NDArray[np.float32], octaves: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """BRIEF-256, upright: descriptors (N, 32) uint8. For arguments see `Describe`.

    Source: Calonder et al., ECCV 2010. Pattern: `src/core/kernels/brief_pattern.inc`.
    """
    descriptors = np.empty((len(pixels), 32), dtype=np.uint8)
    level = image
    for octave in range(int(octaves.max(initial=0)) + 1):
        if octave:
            level = _core.halve(level)
        here = octaves == octave
        positions = np.rint((pixels[here] + 0.5) / 2**octave - 0.5).astype(np.int16)
        descriptors[here] = _core.describe(_core.smooth(level), positions)
    return descriptors


def describe_teblid(
    image: NDArray[np.uint8], pixels: NDArray[np.float32], octaves: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """TEBLID-256, upright, by OpenCV: descriptors (N, 32) uint8. For arguments see `Describe`.

    Source: Suárez et al., Revisiting Binary Local Image Description for Resource Limited Devices,
    RA-L 2021.

    Raises:
        MissingExtraError: OpenCV is installed without its contrib modules.
    """
    import cv2

    if not len(pixels):
        return np.empty((0, 32), dtype=np.uint8)
    extra = xfeatures2d("the feature kind teblid")
    engine = extra.TEBLID_create(_TEBLID_SCALE_FACTOR, extra.TEBLID_SIZE_256_BITS)
    keypoints = [
        cv2.KeyPoint(float(u), float(v), _TEBLID_KEYPOINT_SIZE_PX * 2 ** int(octave), 0)
        for (u, v), octave in zip(pixels, octaves, strict=True)
    ]
    kept, descriptors = engine.compute(image, keypoints)
    assert len(kept) == len(keypoints), "TEBLID keeps all points inside the image"
    return np.asarray(descriptors, dtype=np.uint8)


def detect_corners_with_net(pair: StereoPair, config: FrontendConfig, landmarks: int) -> Keypoints:
    """`detect_corners` and `describe_net`."""
    found = detect_corners_with_brief(pair, config, landmarks)
    assert found.descriptors is not None, "BRIEF comes with the corners"
    described = network.beside_brief(pair.left, found.pixels, found.octaves, found.descriptors)
    return replace(found, descriptors=described)


def describe_net(
    image: NDArray[np.uint8], pixels: NDArray[np.float32], octaves: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """192 bits of the network with 64 of BRIEF: (N, 32) uint8. For arguments see `Describe`."""
    brief = describe_brief(image, pixels, octaves)
    return network.beside_brief(image, pixels, octaves, brief)


FEATURES: dict[DescriptorKind, FeatureKind] = {
    kind.name: kind
    for kind in (
        FeatureKind(
            BRIEF,
            32,
            detect_corners_with_brief,
            describe_brief,
            good_at="the same light, small rooms; cheapest",
        ),
        FeatureKind(
            TEBLID,
            32,
            detect_corners,
            describe_teblid,
            good_at="much as brief; needs OpenCV's contrib modules",
        ),
        FeatureKind(
            NET,
            32,
            detect_corners_with_net,
            describe_net,
            good_at="night, snow, low sun, other seasons",
        ),
    )
}


def feature_kind(name: str) -> FeatureKind:
    """The kind of that name, from the table or an installed package.

    Args:
        name: with or without its model.

    Raises:
        IncompatibleError: the kind is unknown, its model is another one here, or the package that
            adds it cannot be used.
    """
    known = FEATURES.get(DescriptorKind(name))
    if known is not None:
        return known
    plain, _, model = name.partition("@")
    added = _PLUGINS.names()
    if plain in added:
        kind = _PLUGINS.load(plain)
        FEATURES[kind.name] = kind
    here = [kind for kind in FEATURES.values() if plain_name(kind.name) == plain]
    if here and model in {"", here[0].name.partition("@")[2]}:
        return here[0]
    if here:
        raise IncompatibleError(
            f"descriptors of kind {plain} are of model {model or 'none'}, this installation has "
            f"{here[0].name}: install the Engram that made them, or make them again from the "
            f"images: engram record --features {plain}"
        )
    names = sorted({*map(plain_name, FEATURES), *added})
    raise IncompatibleError(
        f"descriptors of kind {name!r} are unknown; known: {', '.join(names)}; "
        "install the package that adds them"
    )


def known_kinds() -> list[FeatureKind]:
    """All kinds, those of installed packages too, in the order of their names."""
    for name in _PLUGINS.names():
        feature_kind(name)
    return [FEATURES[name] for name in sorted(FEATURES)]


def plain_name(kind: str) -> str:
    """A kind's name without its model, as people write it."""
    return kind.partition("@")[0]


def _checked(name: str, found: Any) -> FeatureKind:
    kind = check_is(found, FeatureKind)
    if plain_name(kind.name) != name:
        raise ConfigError(f"its name is {kind.name!r}, must be {name!r}, or {name}@MODEL")
    return kind


_PLUGINS = PluginGroup("engram.features", "kind of features", _checked)


def fitted_matcher(
    matcher: MatcherConfig, before: DescriptorKind, kind: DescriptorKind
) -> MatcherConfig:
    """Matcher settings for another kind; explicitly set values stay.

    Args:
        matcher: settings for features of the kind `before`.
        before: that kind.
        kind: the new kind.

    Raises:
        IncompatibleError: a kind is unknown.
    """
    untouched = (MatcherConfig(), feature_kind(before).matcher)
    suited = feature_kind(kind).matcher
    changes = {
        name: getattr(suited, name)
        for name in (one.name for one in fields(matcher))
        if any(getattr(matcher, name) == getattr(one, name) for one in untouched)
    }
    return replace(matcher, **changes)
