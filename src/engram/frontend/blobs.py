"""Landmarks and thumbnails as bytes, as maps and frame logs store them.

A landmark blob is the first 16 bytes of the SHA-256 of the rest, then a safetensors file (an
eight-byte length, a JSON header with name, type and shape of every array, the arrays). It is
self-describing and cannot execute code. Its metadata name the format, its version and the pixel
quantum. Layout in prose: docs/format.md.

Landmarks as small integers, and back without loss. The front-end quantises its measurements before
any further use, so a frame read back from a log or a map equals the original bit for bit. A
landmark's position takes 7 bytes: u, v and disparity as uint16 multiples of the pixel quantum, the
standard deviation of the disparity as a logarithmic uint8.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

from engram import _core
from engram.errors import InputError, MapCorruptError
from engram.frontend.features import feature_kind
from engram.frontend.frame import DescriptorKind, Landmarks
from engram.geometry.cameras import StereoCamera

# The best disparities have a standard deviation of 0.05 px: finer than 1/64 px gains nothing.
FINEST_QUANTUM_LOG2 = 6
_LARGEST_CODE = 65535

# σ code c means 2^(c/32 - 6) px: from 1/64 px to 3.9 px in steps of 2.2 %.
SIGMA_TABLE_PX = np.exp2(np.arange(256) / 32 - 6).astype(np.float32)
SIGMA_TABLE_PX.setflags(write=False)
# A value gets the code nearest in logarithm: the borders are geometric means.
_SIGMA_BORDERS_PX = np.exp2((np.arange(255) + 0.5) / 32 - 6).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkCodes:
    """The stored positions of landmarks: a struct of arrays, one row per landmark.

    Attributes:
        pixels: (N, 2) uint16, left u, v in pixel quanta.
        disparity: (N,) uint16, in pixel quanta, ≥ 1.
        sigma: (N,) uint8, index into `SIGMA_TABLE_PX`.
    """

    pixels: NDArray[np.uint16]
    disparity: NDArray[np.uint16]
    sigma: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.pixels)


def pixel_quantum(width: int, height: int = 1) -> float:
    """Step of stored pixels and disparities for an image of this size, px.

    The smallest power of two, at least 1/64, for which the longer side fits into 16 bits.
    """
    side = max(width, height)
    if min(width, height) < 1 or side > _LARGEST_CODE:
        raise InputError(f"image size {width}×{height} px: each side must be 1 to {_LARGEST_CODE}")
    steps_log2 = min(FINEST_QUANTUM_LOG2, (_LARGEST_CODE // side).bit_length() - 1)
    return float(2.0**-steps_log2)


def quantise(
    pixels: NDArray[np.float32],
    disparity_px: NDArray[np.float32],
    disparity_sigma_px: NDArray[np.float32],
    quantum_px: float,
) -> LandmarkCodes:
    """Round landmarks to the nearest codes.

    Args:
        pixels: (N, 2) float32, left u, v, px, ≥ 0.
        disparity_px: (N,) float32, px, > 0; values that round to zero become one quantum.
        disparity_sigma_px: (N,) float32, px, > 0; limited to the range of `SIGMA_TABLE_PX`.
        quantum_px: `pixel_quantum` of the image.
    """
    steps_per_px = np.float32(1 / quantum_px)  # a power of two: the product is exact
    pixel_steps = np.rint(pixels * steps_per_px)
    disparity_steps = np.maximum(np.rint(disparity_px * steps_per_px), 1)
    for name, steps in (("pixel", pixel_steps), ("disparity", disparity_steps)):
        if steps.size and not (steps.min() >= 0 and steps.max() <= _LARGEST_CODE):
            raise InputError(
                f"a {name} lies outside 0 to {_LARGEST_CODE * quantum_px} px "
                f"(found {steps.min() * quantum_px} to {steps.max() * quantum_px})"
            )
    return LandmarkCodes(
        pixel_steps.astype(np.uint16),
        disparity_steps.astype(np.uint16),
        np.searchsorted(_SIGMA_BORDERS_PX, disparity_sigma_px).astype(np.uint8),
    )


def dequantise(
    codes: LandmarkCodes, quantum_px: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Pixels (N, 2), disparities (N,) and their σ (N,), all float32 px.

    `quantise` of the result gives the same codes.
    """
    step = np.float32(quantum_px)
    return codes.pixels * step, codes.disparity * step, SIGMA_TABLE_PX[codes.sigma]


def quantised_landmarks(
    pixels: NDArray[np.float32],
    disparity_px: NDArray[np.float32],
    disparity_sigma_px: NDArray[np.float32],
    descriptors: NDArray[np.uint8],
    octaves: NDArray[np.uint8],
    camera: StereoCamera,
) -> Landmarks:
    """N landmarks as they will be stored: `quantise`, then `landmarks_from_codes`, in one call.

    Args:
        pixels: (N, 2) float32, px (x, y) in the left image, from any detector.
        disparity_px, disparity_sigma_px: (N,) float32, px.
        descriptors: (N, B) uint8.
        octaves: (N,) uint8.
    """
    quantum_px = pixel_quantum(camera.width, camera.height)
    quantised = _core.quantise_landmarks(
        pixels,
        disparity_px,
        disparity_sigma_px,
        quantum_px,
        SIGMA_TABLE_PX,
        _SIGMA_BORDERS_PX,
        (camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline_m),
    )
    if quantised is None:  # it is said which
        codes = quantise(pixels, disparity_px, disparity_sigma_px, quantum_px)
        return landmarks_from_codes(codes, descriptors, octaves, camera)
    return Landmarks(*quantised, descriptors, octaves)


def landmarks_from_codes(
    codes: LandmarkCodes,
    descriptors: NDArray[np.uint8],
    octaves: NDArray[np.uint8],
    camera: StereoCamera,
) -> Landmarks:
    """N landmarks from their stored codes; all landmarks are made here.

    Args:
        codes: positions of N landmarks, in quanta of the camera's image.
        descriptors: (N, B) uint8.
        octaves: (N,) uint8.
        camera: the camera that saw them; gives the quantum and the points.
    """
    quantum_px = pixel_quantum(camera.width, camera.height)
    pixels, disparity_px, sigma_px = dequantise(codes, quantum_px)
    points = camera.triangulate(pixels, disparity_px)
    return Landmarks(pixels, disparity_px, sigma_px, points, descriptors, octaves)


LANDMARK_FORMAT = 1
HASH_BYTES = 16

# A single entry: the order of several differs between processes, and equal landmarks must give
# equal bytes.
_METADATA_KEY = "engram.landmarks"
_ROW_SHAPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "pixels": ("U16", (2,)),
    "disparity": ("U16", ()),
    "descriptors": ("U8", ()),  # and as many columns as the kind has bytes
    "octaves": ("U8", ()),
    "sigma": ("U8", ()),
}
_DTYPES: dict[str, np.dtype[Any]] = {"U16": np.dtype("<u2"), "U8": np.dtype("u1")}

# Enough to recognise a place at 160 px, at a third of the size of PNG.
_JPEG_QUALITY = 80
_THUMBNAIL_SIDE_LIMIT = 1024


def content_digest(content: bytes) -> bytes:
    """16-byte hash of `content`: truncated SHA-256, the fastest hash with SHA-NI."""
    return hashlib.sha256(content).digest()[:HASH_BYTES]


def encode_landmarks(landmarks: Landmarks, camera: StereoCamera) -> bytes:
    """The blob of a frame's landmarks; equal landmarks give equal bytes.

    Args:
        landmarks: landmarks of the front-end, in the quanta of `camera`'s image.
    """
    quantum_px = pixel_quantum(camera.width, camera.height)
    codes = quantise(
        landmarks.pixels, landmarks.disparity_px, landmarks.disparity_sigma_px, quantum_px
    )
    _check_exact(
        landmarks,
        landmarks_from_codes(codes, landmarks.descriptors, landmarks.octaves, camera),
    )
    arrays = {
        "pixels": codes.pixels,
        "disparity": codes.disparity,
        "descriptors": landmarks.descriptors,
        "octaves": landmarks.octaves,
        "sigma": codes.sigma,
    }
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    body = safetensors.numpy.save(contiguous, {_METADATA_KEY: _metadata(quantum_px)})
    return content_digest(body) + body


def decode_landmarks(blob: bytes, camera: StereoCamera, kind: DescriptorKind) -> Landmarks:
    """The landmarks of a blob, bit for bit those that were encoded.

    Args:
        blob: a result of `encode_landmarks`, of any origin.
    """
    body = blob[HASH_BYTES:]
    if len(blob) < HASH_BYTES or content_digest(body) != blob[:HASH_BYTES]:
        raise MapCorruptError(f"landmark blob of {len(blob)} bytes does not match its hash")
    try:
        tensors = safetensors.deserialize(body)  # type: ignore[no-untyped-call]  # as it comes
    except safetensors.SafetensorError as error:
        raise MapCorruptError(f"landmark blob is not a safetensors file: {error}") from error
    _check_metadata(body, pixel_quantum(camera.width, camera.height))
    arrays = _checked_arrays(tensors, feature_kind(kind).descriptor_bytes)
    if not arrays["disparity"].all():
        raise MapCorruptError("landmark blob holds a disparity of zero, a point at infinity")
    codes = LandmarkCodes(arrays["pixels"], arrays["disparity"], arrays["sigma"])
    return landmarks_from_codes(codes, arrays["descriptors"], arrays["octaves"], camera)


def blob_hash(blob: bytes) -> bytes:
    """The 16-byte hash stored in a landmark blob, unchecked."""
    return blob[:HASH_BYTES]


def is_intact(blob: bytes) -> bool:
    """Whether a landmark blob matches its hash, without decoding it."""
    return content_digest(blob[HASH_BYTES:]) == blob[:HASH_BYTES]


def encode_thumbnail(thumbnail: NDArray[np.uint8]) -> bytes:
    """A (h, w) uint8 grey picture as JPEG, for people to look at."""
    if (
        thumbnail.ndim != 2
        or thumbnail.dtype != np.uint8
        or not 1 <= min(thumbnail.shape) <= max(thumbnail.shape) <= _THUMBNAIL_SIDE_LIMIT
    ):
        raise InputError(
            f"a thumbnail is (h, w) uint8 with sides of 1 to {_THUMBNAIL_SIDE_LIMIT} px, "
            f"not {thumbnail.shape} {thumbnail.dtype}"
        )
    _, encoded = cv2.imencode(".jpg", thumbnail, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return encoded.tobytes()


def decode_thumbnail(data: bytes) -> NDArray[np.uint8]:
    """The (h, w) uint8 grey picture of `encode_thumbnail`."""
    if not data.startswith(b"\xff\xd8") or not _jpeg_is_small(data):
        raise MapCorruptError(f"thumbnail of {len(data)} bytes is not a small JPEG picture")
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error as error:
        raise MapCorruptError(f"thumbnail cannot be decoded: {error}") from error
    if picture is None:
        raise MapCorruptError(f"thumbnail of {len(data)} bytes cannot be decoded")
    return picture.astype(np.uint8, copy=False)


def _metadata(quantum_px: float) -> str:
    return f"version={LANDMARK_FORMAT} quantum_px={quantum_px!r}"


def _check_exact(given: Landmarks, stored: Landmarks) -> None:
    for name in ("pixels", "disparity_px", "disparity_sigma_px", "points_in_cam"):
        if not np.array_equal(getattr(given, name), getattr(stored, name)):
            raise InputError(
                f"landmarks cannot be stored without loss: their {name} differ from those of their "
                "codes; make them with landmarks_from_codes"
            )
    count = len(given.pixels)
    for name, dtype, shape in (
        ("descriptors", np.uint8, (count, *given.descriptors.shape[1:2])),
        ("octaves", np.uint8, (count,)),
    ):
        array = getattr(given, name)
        if array.dtype != dtype or array.shape != shape:
            raise InputError(
                f"landmarks: {name} must be {shape} {np.dtype(dtype)}, "
                f"not {array.shape} {array.dtype}"
            )


def _check_metadata(body: bytes, quantum_px: float) -> None:
    """Checks the metadata in the header's bytes, as the reader does not expose them."""
    header = body[8 : 8 + int.from_bytes(body[:8], "little")]
    expected = f'"__metadata__":{{"{_METADATA_KEY}":"{_metadata(quantum_px)}"}}'
    if expected.encode() not in header:
        raise MapCorruptError(
            f"landmark blob is not of version {LANDMARK_FORMAT} with quantum {quantum_px} px: "
            f"its header begins {header[:96]!r}; it belongs to another camera or was written by a "
            "newer Engram"
        )


def _checked_arrays(
    tensors: list[tuple[str, dict[str, Any]]], descriptor_bytes: int
) -> dict[str, NDArray[Any]]:
    """Arrays by name, with checked names, types and shapes."""
    found = dict(tensors)
    if found.keys() != _ROW_SHAPES.keys():
        raise MapCorruptError(f"landmark blob holds {sorted(found)}, not {sorted(_ROW_SHAPES)}")
    shape = found["octaves"]["shape"]
    count = shape[0] if isinstance(shape, list) and len(shape) == 1 else -1
    arrays = {}
    for name, (dtype, row_shape) in _ROW_SHAPES.items():
        tensor = found[name]
        shape = [count, descriptor_bytes] if name == "descriptors" else [count, *row_shape]
        if tensor["dtype"] != dtype or tensor["shape"] != shape:
            raise MapCorruptError(
                f"landmark blob: {name} is {tensor['dtype']} {tensor['shape']}, not {dtype} {shape}"
            )
        arrays[name] = np.frombuffer(tensor["data"], _DTYPES[dtype]).reshape(shape)
    return arrays


def _jpeg_is_small(data: bytes) -> bool:
    """Whether the first frame header gives sides within the limit, before memory is allocated."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in {0xC4, 0xC8, 0xCC}:
            height = int.from_bytes(data[at + 5 : at + 7], "big")
            width = int.from_bytes(data[at + 7 : at + 9], "big")
            return 1 <= min(height, width) <= max(height, width) <= _THUMBNAIL_SIDE_LIMIT
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return False
