"""Landmark blobs and thumbnails: exact round trips, and nothing hostile gets through."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given, settings
from hypothesis import strategies as st

from engram.errors import InputError, MapCorruptError
from engram.frontend.blobs import (
    blob_hash,
    content_digest,
    decode_landmarks,
    decode_thumbnail,
    encode_landmarks,
    encode_thumbnail,
)
from engram.frontend.frame import BRIEF
from engram.geometry.cameras import StereoCamera

from .frames import CAMERA, assert_same_landmarks, landmarks

BLOB = encode_landmarks(landmarks(7), CAMERA)
WIDE = StereoCamera(
    fx=900.0, fy=900.0, cx=1000.0, cy=600.0, baseline_m=0.3, width=2048, height=1200
)


def sealed(body: bytes) -> bytes:
    return content_digest(body) + body


def body_with(**changes: object) -> bytes:
    """A body with a correct hash but other arrays than the format has."""
    arrays = safetensors.numpy.load(BLOB[16:])
    for name, array in changes.items():
        if array is None:
            del arrays[name]
        else:
            arrays[name] = array
    return safetensors.numpy.save(arrays, {"engram.landmarks": "version=1 quantum_px=0.015625"})


@given(
    count=st.integers(0, 700), seed=st.integers(0, 2**32), camera=st.sampled_from([CAMERA, WIDE])
)
@settings(max_examples=40)
def test_landmarks_come_back_bit_for_bit(count, seed, camera):
    written = landmarks(count, seed, camera)
    blob = encode_landmarks(written, camera)
    assert_same_landmarks(decode_landmarks(blob, camera, BRIEF), written)
    assert encode_landmarks(written, camera) == blob
    assert blob_hash(blob) == content_digest(blob[16:])


def test_a_landmark_takes_40_bytes():
    per_landmark = len(encode_landmarks(landmarks(600), CAMERA)) / 600
    assert per_landmark < 40 + 500 / 600  # 6 + 1 + 1 + 32 bytes, and the header once


@pytest.mark.parametrize("field", ["pixels", "disparity_px", "disparity_sigma_px", "points_in_cam"])
def test_landmarks_that_would_not_come_back_are_refused(field):
    good = landmarks(5)
    off_the_quantum = dataclasses.replace(
        good, **{field: getattr(good, field) * np.float32(1.0001)}
    )
    with pytest.raises(InputError, match=r"without loss|outside"):
        encode_landmarks(off_the_quantum, CAMERA)


def test_nan_is_refused_when_writing():
    good = landmarks(5)
    broken = good.pixels.copy()
    broken[2, 1] = np.nan
    with pytest.raises(InputError):
        encode_landmarks(dataclasses.replace(good, pixels=broken), CAMERA)


@pytest.mark.parametrize("field", ["descriptors", "octaves"])
def test_arrays_of_another_length_are_refused_when_writing(field):
    good = landmarks(5)
    with pytest.raises(InputError, match=field):
        encode_landmarks(dataclasses.replace(good, **{field: getattr(good, field)[:4]}), CAMERA)


@given(at=st.integers(0, len(BLOB) - 1), bit=st.integers(0, 7))
def test_any_flipped_bit_is_found(at, bit):
    broken = bytearray(BLOB)
    broken[at] ^= 1 << bit
    with pytest.raises(MapCorruptError, match="hash"):
        decode_landmarks(bytes(broken), CAMERA, BRIEF)


@given(length=st.integers(0, len(BLOB) - 1))
@settings(max_examples=50)
def test_a_cut_blob_is_found(length):
    with pytest.raises(MapCorruptError, match="hash"):
        decode_landmarks(BLOB[:length], CAMERA, BRIEF)


@given(body=st.binary(max_size=400))
def test_random_bytes_with_a_right_hash_are_refused(body):
    with pytest.raises(MapCorruptError):
        decode_landmarks(sealed(body), CAMERA, BRIEF)


@given(at=st.integers(0, len(BLOB) - 17), value=st.integers(0, 255))
def test_hostile_bytes_with_a_right_hash_give_landmarks_or_a_clear_error(at, value):
    body = bytearray(BLOB[16:])
    body[at] = value
    try:
        read = decode_landmarks(sealed(bytes(body)), CAMERA, BRIEF)
    except MapCorruptError:
        return
    assert len(read) == 7
    assert np.isfinite(read.points_in_cam).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"octaves": None},
        {"more": np.zeros(7, np.uint8)},
        {"octaves": np.zeros(6, np.uint8)},
        {"pixels": np.zeros((7, 3), np.uint16)},
        {"pixels": np.zeros((7, 2), np.float16)},
        {"descriptors": np.zeros((7, 16), np.uint8)},
        {"octaves": np.zeros((7, 1), np.uint8)},
        {"octaves": np.array(3, np.uint8)},
        {"disparity": np.zeros(7, np.uint16)},
    ],
    ids="-".join,
)
def test_wrong_arrays_are_refused(changes):
    with pytest.raises(MapCorruptError):
        decode_landmarks(sealed(body_with(**changes)), CAMERA, BRIEF)


@pytest.mark.parametrize("length", [2**62, 100_000_001, 2**64 - 1])
def test_a_huge_header_is_refused_without_memory(length):
    body = length.to_bytes(8, "little") + b"{}"
    with pytest.raises(MapCorruptError, match="safetensors"):
        decode_landmarks(sealed(body), CAMERA, BRIEF)


def test_a_huge_shape_is_refused_without_memory():
    header = json.dumps(
        {"pixels": {"dtype": "U16", "shape": [2**60, 2], "data_offsets": [0, 2**62]}}
    ).encode()
    with pytest.raises(MapCorruptError, match="safetensors"):
        decode_landmarks(sealed(len(header).to_bytes(8, "little") + header), CAMERA, BRIEF)


def test_the_camera_of_another_image_size_is_refused():
    with pytest.raises(MapCorruptError, match="quantum"):
        decode_landmarks(BLOB, WIDE, BRIEF)


def test_a_newer_version_is_refused():
    newer = BLOB[16:].replace(b"version=1", b"version=2")
    with pytest.raises(MapCorruptError, match="version 1"):
        decode_landmarks(sealed(newer), CAMERA, BRIEF)


def test_a_thumbnail_is_recognisable():
    rows, columns = np.mgrid[0:120, 0:160]
    picture = (128 + 60 * np.sin(rows / 9) + 50 * np.cos(columns / 13)).astype(np.uint8)
    read = decode_thumbnail(encode_thumbnail(picture))
    assert read.shape == picture.shape
    # JPEG at quality 80 keeps smooth pictures within a few grey levels.
    assert np.abs(read.astype(int) - picture).max() < 12


@pytest.mark.parametrize("shape", [(0, 10), (10, 2000), (4, 4, 3)])
def test_what_is_no_thumbnail_is_refused(shape):
    with pytest.raises(InputError, match="thumbnail"):
        encode_thumbnail(np.zeros(shape, np.uint8))


JPEG = encode_thumbnail(np.arange(1200, dtype=np.uint8).reshape(30, 40))


@given(junk=st.binary(max_size=100), keep=st.integers(0, len(JPEG)))
def test_hostile_thumbnails_give_a_picture_or_a_clear_error(junk, keep):
    try:
        picture = decode_thumbnail(JPEG[:keep] + junk)
    except MapCorruptError:
        return
    assert picture.shape == (30, 40)


def test_a_thumbnail_that_would_fill_the_memory_is_refused():
    _, huge = cv2.imencode(".jpg", np.zeros((1100, 20), np.uint8))
    with pytest.raises(MapCorruptError, match="small JPEG"):
        decode_thumbnail(huge.tobytes())
