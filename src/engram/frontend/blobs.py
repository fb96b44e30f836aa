"""Landmarks and thumbnails as bytes, as maps and frame logs store them.

A landmark blob is the first 16 bytes of the SHA-256 of the rest, then a safetensors file (an
eight-byte length, a JSON header with name, type and shape of every array, the arrays). It is
self-describing and cannot execute code. Its metadata name the format, its version and the pixel
quantum. Layout in prose: docs/format.md.
"""

from __future__ import annotations

import hashlib
from typing import Any

import cv2
import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

from engram.errors import InputError, MapCorruptError
from engram.frontend import DescriptorKind, Landmarks, feature_kind
from engram.frontend.quantisation import (
    LandmarkCodes,
    landmarks_from_codes,
    pixel_quantum,
    quantise,
)
from engram.geometry import StereoCamera

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
        camera: the camera of the frame.

    Raises:
        InputError: the landmarks are not exactly representable by their codes.
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
        camera: the camera of the frame.
        kind: kind of its descriptors.

    Raises:
        IncompatibleError: the kind is unknown.
        MapCorruptError: the bytes do not match their hash, are not a landmark blob of a known
            version, or hold invalid values.
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
    """A (h, w) uint8 grey picture as JPEG, for people to look at.

    Raises:
        InputError: not a (h, w) uint8 array with sides of 1 to 1024 px.
    """
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
    """The (h, w) uint8 grey picture of `encode_thumbnail`.

    Raises:
        MapCorruptError: the bytes are not a JPEG picture of at most 1024 px.
    """
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
