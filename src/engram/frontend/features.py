"""The kinds of features: how landmarks are detected and described, in one table.

All other code takes the width of a descriptor from this table. Another package adds a kind by an
entry point of the group `engram.features` that names a `FeatureKind`.

The kind of features `net`: descriptors by a small network, with some of BRIEF's bits. A patch of
48×48 px around each corner goes through three convolutions and a linear layer in 8-bit integers,
whose signs are 192 bits. Light, season and weather change them far less than BRIEF; rain and small
rooms favour BRIEF, of which 64 bits are added.

Corners that the left and the right image share, wherever they lie. The front-end searches along the
row and to the left only, as a calibrated pair demands. Here nothing is demanded, so that what is
wrong with a pair shows.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load

from engram import _core
from engram.errors import ConfigError, IncompatibleError
from engram.frontend.frame import BRIEF, DescriptorKind, StereoPair
from engram.frontend.matching import MatcherConfig
from engram.plugins import PluginGroup, check_is, where_from

if TYPE_CHECKING:
    from collections.abc import Mapping

    from engram.frontend.frontend import FrontendConfig


# The first eight hexadecimal digits of the SHA-256 of its weights. Part of the kind's name in maps
# and frame logs, so that descriptors of two models never meet.
MODEL = "595cbcd3"
NETWORK_BITS, BRIEF_BITS = 192, 64

_FILE = "net.safetensors"
_ARRAYS = (
    "first",
    "second",
    "third",
    "linear",
    "first_scaling",
    "second_scaling",
    "third_scaling",
    "thresholds",
    "shifts",
)


def weights() -> Mapping[str, NDArray[Any]]:
    """The arrays of `engram._core.PatchNetwork`, by the names of its arguments.

    Four (out, side, side, in) int8 layers of weights; the rest int32, (n,) factors and limits.
    """
    body = (resources.files("engram.frontend") / "data" / _FILE).read_bytes()
    digest = hashlib.sha256(body).hexdigest()[: len(MODEL)]
    if digest != MODEL:
        raise IncompatibleError(
            f"the installed weights {_FILE} are model {digest}, must be {MODEL}; "
            "install Engram again"
        )
    arrays: Mapping[str, NDArray[Any]] = load(body)
    return arrays


@cache
def network() -> _core.PatchNetwork:
    """The network, read once."""
    arrays = weights()
    return _core.PatchNetwork(**{name: arrays[name] for name in _ARRAYS})


def beside_brief(
    image: NDArray[np.uint8],
    pixels: NDArray[np.float32],
    octaves: NDArray[np.uint8],
    brief: NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """The network's bits and the first of BRIEF's: descriptors (N, 32) uint8.

    Args:
        image: (h, w) uint8 grey.
        pixels: (N, 2) float32 u, v, px.
        octaves: (N,) uint8.
        brief: (N, 32) uint8, BRIEF-256 of the same points.
    """
    descriptors = network().describe(image, pixels, octaves)
    return np.concatenate([descriptors, brief[:, : BRIEF_BITS // 8]], axis=1)


NET = DescriptorKind(f"net@{MODEL}")


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

    def rows(self, chosen: NDArray[np.bool_]) -> Keypoints:
        """Some of them, in their order.

        Args:
            chosen: (N,) bool.
        """
        return replace(
            self,
            pixels=self.pixels[chosen],
            disparity_px=self.disparity_px[chosen],
            sigma_px=self.sigma_px[chosen],
            octaves=self.octaves[chosen],
            descriptors=None if self.descriptors is None else self.descriptors[chosen],
        )


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
        describe: describes them, if `detect` does not.
        matcher: suitable matcher settings; they replace those left at their defaults.
        good_at: what to choose it for, in a few words.
        vocabulary: file with the visual words of maps that have none of their own.
    """

    name: DescriptorKind
    descriptor_bytes: int
    detect: Detect
    describe: Describe
    matcher: MatcherConfig = field(default_factory=MatcherConfig)
    good_at: str = ""
    vocabulary: Path | None = None

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
        on_level = octaves == octave
        positions = np.rint((pixels[on_level] + 0.5) / 2**octave - 0.5).astype(np.int16)
        descriptors[on_level] = _core.describe(_core.smooth(level), positions)
    return descriptors


def detect_corners_with_net(pair: StereoPair, config: FrontendConfig, landmarks: int) -> Keypoints:
    """`detect_corners` and `describe_net`."""
    corners = detect_corners_with_brief(pair, config, landmarks)
    assert corners.descriptors is not None, "BRIEF comes with the corners"
    described = beside_brief(pair.left, corners.pixels, corners.octaves, corners.descriptors)
    return replace(corners, descriptors=described)


def describe_net(
    image: NDArray[np.uint8], pixels: NDArray[np.float32], octaves: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """192 bits of the network with 64 of BRIEF: (N, 32) uint8. For arguments see `Describe`."""
    brief = describe_brief(image, pixels, octaves)
    return beside_brief(image, pixels, octaves, brief)


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
            NET,
            32,
            detect_corners_with_net,
            describe_net,
            good_at="night, snow, low sun, other seasons",
        ),
    )
}


_OURS = (detect_corners, detect_corners_with_brief, detect_corners_with_net)


def has_our_corners(kind: FeatureKind) -> bool:
    """Whether a kind describes the front-end's own corners, of which more can be found."""
    return kind.detect in _OURS


def feature_kind(name: str) -> FeatureKind:
    """The kind of that name, from the table or an installed package."""
    known = FEATURES.get(DescriptorKind(name))
    if known is not None:
        return known
    plain, _, model = name.partition("@")
    added = _PLUGINS.names()
    if plain in added:
        kind = _PLUGINS.load(plain)
        FEATURES[kind.name] = kind
    candidates = [kind for kind in FEATURES.values() if plain_name(kind.name) == plain]
    if candidates and model in {"", candidates[0].name.partition("@")[2]}:
        return candidates[0]
    if candidates:
        raise IncompatibleError(
            f"descriptors of kind {plain} are of model {model or 'none'}, this installation has "
            f"{candidates[0].name}: install the Engram that made them, or make them again from the "
            f"images: engram record --features {plain}"
        )
    names = sorted({*map(plain_name, FEATURES), *added})
    raise IncompatibleError(
        f"descriptors of kind {name!r} are unknown{where_from(plain)}; known: {', '.join(names)}; "
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
    """
    untouched = (MatcherConfig(), feature_kind(before).matcher)
    suited = feature_kind(kind).matcher
    changes = {
        name: getattr(suited, name)
        for name in (field.name for field in fields(matcher))
        if any(getattr(matcher, name) == getattr(defaults, name) for defaults in untouched)
    }
    return replace(matcher, **changes)


Array = NDArray[np.float64]

_CORNERS = 400
_FAST_THRESHOLD = 7
_CELL_PX = 32
# Most different bits of a BRIEF descriptor of 256: a random pair differs in 128 ± 8.
_MOST_BITS = 64
_RATIO = 0.85
# Vertical offsets further than this from the usual one are wrong matches.
_WRONG_PX = 40.0


@dataclass(frozen=True, slots=True, eq=False)
class SideMatches:
    """Corners that both images show.

    Attributes:
        pixels: (M, 2) float64, left u, v, px.
        shift: (M, 2) float64, left minus right u and v, px: disparity and vertical offset.
    """

    pixels: Array
    shift: Array

    def __len__(self) -> int:
        return len(self.pixels)


def match_sides(pair: StereoPair) -> SideMatches:
    """Mutually nearest corners of a pair, the wrong ones mostly removed."""
    (left, of_left), (right, of_right) = (
        _core.best_corners(image, _FAST_THRESHOLD, _CELL_PX, _CORNERS)
        for image in (pair.left, pair.right)
    )
    if min(len(left), len(right)) < 2:
        return SideMatches(np.zeros((0, 2)), np.zeros((0, 2)))
    bits = _core.hamming_matrix(of_left, of_right)
    nearest = bits.argmin(axis=1)
    rows = np.arange(len(left))
    best = bits[rows, nearest].astype(np.float64)
    bits[rows, nearest] = 999
    kept = (best <= _MOST_BITS) & (best < _RATIO * bits.min(axis=1))
    bits[rows, nearest] = best
    kept &= bits.argmin(axis=0)[nearest] == rows
    pixels, shift = left[kept], left[kept] - right[nearest[kept]]
    near = np.abs(shift[:, 1] - np.median(shift[:, 1])) < _WRONG_PX if len(shift) else kept[:0]
    return SideMatches(pixels[near], shift[near])
