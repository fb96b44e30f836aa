"""Converts logged frames to rows and back, with a digest over the columns."""

from __future__ import annotations

import hashlib
import json
import types
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import func

from engram.errors import InputError, MapCorruptError
from engram.frontend import Frame, FrameStatus
from engram.frontend.blobs import (
    HASH_BYTES,
    content_digest,
    decode_landmarks,
    decode_thumbnail,
    encode_landmarks,
    encode_thumbnail,
)
from engram.geometry import SE3
from engram.odometry import OdometryStatus, OdometryStep
from engram.sequences.framelog.file import frames_table
from engram.sequences.framelog.header import FrameLogHeader
from engram.sequences.sequence import LoggedFrame

# All columns, with the blobs replaced by their leading hashes: enough for a skipped frame.
STEP_COLUMNS = (
    *[column for column in frames_table.columns if column.name not in {"landmarks", "thumbnail"}],
    func.substr(frames_table.c.landmarks, 1, HASH_BYTES).label("landmarks_hash"),
    func.substr(frames_table.c.thumbnail, 1, HASH_BYTES).label("thumbnail_hash"),
)

_COLUMN_KINDS: dict[str, type | types.UnionType] = {
    "number": int,
    "stamp_ns": int,
    "status": str,
    "pair_hash": str,
    "odometry_status": str,
    "inliers": int,
    "prev_from_curr": bytes | None,
    "covariance": bytes | None,
    "digest": bytes,
    "landmarks_hash": bytes,
    "thumbnail_hash": bytes | None,
}


@dataclass(frozen=True, slots=True, eq=False)
class StepRow:
    """A row without its blobs.

    Attributes:
        number: place in the log.
        stamp_ns: stamp of the frame.
        status: status of the frame.
        pair_hash: `first_pair_hash` of the frame's images.
        odometry: ``prev_from_curr`` since the frame before, with its covariance.
    """

    number: int
    stamp_ns: int
    status: FrameStatus
    pair_hash: str
    odometry: OdometryStep


def encode_row(number: int, logged: LoggedFrame, pair_hash: str) -> dict[str, Any]:
    """The row of a frame.

    Raises:
        InputError: the landmarks or the thumbnail cannot be stored without loss.
    """
    frame, step = logged.frame, logged.odometry
    thumbnail = None
    if frame.thumbnail is not None:
        picture = encode_thumbnail(frame.thumbnail)
        thumbnail = content_digest(picture) + picture
    row: dict[str, Any] = {
        "number": number,
        "stamp_ns": int(frame.stamp_ns),
        "status": frame.status.value,
        "pair_hash": pair_hash,
        "odometry_status": step.status.value,
        "inliers": int(step.inliers),
        "prev_from_curr": _motion_bytes(step),
        "covariance": _covariance_bytes(step),
        "landmarks": encode_landmarks(frame.landmarks, frame.camera),
        "thumbnail": thumbnail,
    }
    row["digest"] = row_digest(
        row, row["landmarks"][:HASH_BYTES], None if thumbnail is None else thumbnail[:HASH_BYTES]
    )
    return row


def decode_step(row: Any) -> StepRow:
    """A row selected by `STEP_COLUMNS`.

    Raises:
        MapCorruptError: the columns do not match their digest, or hold impossible values.
    """
    columns = dict(row._mapping)
    where = f"frame {columns['number']}"
    for name, kinds in _COLUMN_KINDS.items():
        if not isinstance(columns[name], kinds):
            raise MapCorruptError(f"{where} of the frame log: {name} is {columns[name]!r:.40}")
    if (
        row_digest(columns, columns["landmarks_hash"], columns["thumbnail_hash"])
        != columns["digest"]
    ):
        raise MapCorruptError(f"{where} of the frame log does not match its hash")
    try:
        odometry = _step(columns)
        status = FrameStatus(columns["status"])
    except ValueError as error:
        raise MapCorruptError(f"{where} of the frame log: {error}") from error
    return StepRow(columns["number"], columns["stamp_ns"], status, columns["pair_hash"], odometry)


def decode_frame(
    step: StepRow, landmarks: bytes, thumbnail: bytes | None, header: FrameLogHeader
) -> Frame:
    """The frame of a row.

    Raises:
        MapCorruptError: a blob does not match its hash or holds impossible values.
    """
    try:
        picture = None if thumbnail is None else decode_thumbnail(_checked(thumbnail))
        return Frame(
            stamp_ns=step.stamp_ns,
            camera=header.camera,
            landmarks=decode_landmarks(landmarks, header.camera, header.descriptor),
            descriptor=header.descriptor,
            frontend=header.frontend,
            status=step.status,
            thumbnail=picture,
        )
    except MapCorruptError as error:
        raise MapCorruptError(f"frame {step.number} of the frame log: {error}") from error


def _checked(thumbnail: bytes) -> bytes:
    if content_digest(thumbnail[HASH_BYTES:]) != thumbnail[:HASH_BYTES]:
        raise MapCorruptError("the thumbnail does not match its hash")
    return thumbnail[HASH_BYTES:]


def _motion_bytes(step: OdometryStep) -> bytes | None:
    if step.status is not OdometryStatus.OK:
        return None
    if step.prev_from_curr is None or step.covariance is None:
        raise InputError("an odometry step that is OK has a motion and a covariance")
    return step.prev_from_curr.matrix()[:3].astype("<f8").tobytes()


def _covariance_bytes(step: OdometryStep) -> bytes | None:
    if step.status is not OdometryStatus.OK or step.covariance is None:
        return None
    if step.covariance.shape != (6, 6):
        raise InputError(f"a covariance has shape (6, 6), not {step.covariance.shape}")
    return step.covariance.astype("<f8").tobytes()


def _step(columns: dict[str, Any]) -> OdometryStep:
    status = OdometryStatus(columns["odometry_status"])
    if status is not OdometryStatus.OK:
        return OdometryStep(status)
    matrix = _floats(columns["prev_from_curr"], (3, 4))
    return OdometryStep(
        status,
        SE3(matrix[:, :3].copy(), matrix[:, 3].copy()),
        _floats(columns["covariance"], (6, 6)),
        columns["inliers"],
    )


def _floats(content: bytes | None, shape: tuple[int, int]) -> NDArray[np.float64]:
    if content is None or len(content) != 8 * shape[0] * shape[1]:
        raise ValueError("motion or covariance is missing or of the wrong length")
    values = np.frombuffer(content, dtype="<f8").astype(np.float64).reshape(shape)
    if not np.isfinite(values).all():
        raise ValueError("motion or covariance is not finite")
    return values


def row_digest(row: dict[str, Any], landmarks_hash: bytes, thumbnail_hash: bytes | None) -> bytes:
    """The digest of a row: over its columns and the hashes that its blobs begin with."""
    content = [
        *(row[name] for name in ("number", "stamp_ns", "status", "pair_hash")),
        *(row[name] for name in ("odometry_status", "inliers")),
        *(
            None if value is None else value.hex()
            for value in (row["prev_from_curr"], row["covariance"], landmarks_hash, thumbnail_hash)
        ),
    ]
    return hashlib.sha256(json.dumps(content).encode()).digest()[:HASH_BYTES]
