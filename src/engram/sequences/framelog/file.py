"""The SQLite file of a frame log: tables, header, and rows of frames."""

from __future__ import annotations

import hashlib
import json
import sqlite3
import types
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import (
    BigInteger,
    Column,
    Connection,
    Integer,
    LargeBinary,
    MetaData,
    Table,
    Text,
    func,
)
from sqlalchemy.exc import OperationalError

from engram.errors import EngramError, IncompatibleError, InputError, MapCorruptError, SequenceError
from engram.frontend.blobs import (
    HASH_BYTES,
    content_digest,
    decode_landmarks,
    decode_thumbnail,
    encode_landmarks,
    encode_thumbnail,
)
from engram.frontend.features import feature_kind
from engram.frontend.frame import DescriptorKind, Frame, FrameStatus
from engram.frontend.ranked import RankedLandmarks
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.clock import check_longitude, is_zone_name
from engram.graph.model import Clock
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.sequences.sequence import LoggedFrame, SequenceInfo
from engram.sqlite import FileKind, SqliteFile

metadata = MetaData()

_INT64 = BigInteger().with_variant(Integer(), "sqlite")

# One row. `complete` is the number of frames once the whole drive is recorded, before that 0;
# `digest` is `log_digest`.
log_table = Table(
    "log",
    metadata,
    Column("key", _INT64, primary_key=True, autoincrement=False),
    Column("header", Text(), nullable=False),
    Column("tool_version", Text(), nullable=False),
    Column("complete", _INT64, nullable=False),
    Column("digest", LargeBinary(), nullable=False),
    sqlite_strict=True,
)


def log_digest(header: str, complete: int) -> bytes:
    """Hash of a log's row: of the header, and of the number of frames once all are recorded."""
    return content_digest(f"{header}{complete or ''}".encode())


# One row a frame, numbered from 0 without gaps. The blobs have their own hashes; `digest` covers
# all other columns and those hashes.
frames_table = Table(
    "frames",
    metadata,
    Column("number", _INT64, primary_key=True, autoincrement=False),
    Column("stamp_ns", _INT64, nullable=False, unique=True),
    Column("status", Text(), nullable=False),
    Column("pair_hash", Text(), nullable=False),
    Column("odometry_status", Text(), nullable=False),
    Column("inliers", _INT64, nullable=False),
    Column("prev_from_curr", LargeBinary()),  # (3, 4) float64, little-endian, row-major
    Column("covariance", LargeBinary()),  # (6, 6) float64 likewise
    Column("digest", LargeBinary(), nullable=False),
    Column("landmarks", LargeBinary(), nullable=False),
    Column("thumbnail", LargeBinary()),  # 16 bytes of SHA-256, then JPEG
    sqlite_strict=True,
)


# One row for each frame of which more landmarks are kept than it has: those, and the ranks (uint16,
# little-endian) of both in the order of `RankedLandmarks`. `digest` ties them to the frame.
more_table = Table(
    "more",
    metadata,
    Column("number", _INT64, primary_key=True, autoincrement=False),
    Column("ranks", LargeBinary(), nullable=False),
    Column("landmarks", LargeBinary(), nullable=False),
    Column("digest", LargeBinary(), nullable=False),
    sqlite_strict=True,
)


FRAME_LOG = FileKind(
    noun="frame log",
    application_id=0x456E464C,  # "EnFL"
    format_version=3,
    metadata=metadata,
    strange=SequenceError,
    cure="restore a copy or record it again",
    busy_s=1.0,  # a second writer gives up after this; a reader never waits for a writer
    older="record the drive again",
)


FLIGHT_SUFFIX = ".flight"
_flight_metadata = MetaData()
for _table in (log_table, frames_table):
    _table.to_metadata(_flight_metadata)

# One row: why and where the record was made, JSON.
report_table = Table(
    "report",
    _flight_metadata,
    Column("key", _INT64, primary_key=True, autoincrement=False),
    Column("content", Text(), nullable=False),
    Column("digest", LargeBinary(), nullable=False),
    sqlite_strict=True,
)
# One row a frame: what the robot concluded, JSON.
decisions_table = Table(
    "decisions",
    _flight_metadata,
    Column("number", _INT64, primary_key=True, autoincrement=False),
    Column("content", Text(), nullable=False),
    Column("digest", LargeBinary(), nullable=False),
    sqlite_strict=True,
)
# One row a frame with images, JPEG; none in a record without images.
images_table = Table(
    "images",
    _flight_metadata,
    Column("number", _INT64, primary_key=True, autoincrement=False),
    Column("left_image", LargeBinary(), nullable=False),
    Column("right_image", LargeBinary(), nullable=False),
    Column("digest", LargeBinary(), nullable=False),
    sqlite_strict=True,
)

# A frame log of a robot's last seconds, with images and decisions beside it.
FLIGHT_RECORD = FileKind(
    noun="flight record",
    application_id=0x456E4652,  # "EnFR"
    format_version=2,
    metadata=_flight_metadata,
    strange=SequenceError,
    cure="restore a copy",
    busy_s=1.0,
    older="it can be read by the Engram that wrote it",
)


def framelog_file(path: Path) -> SqliteFile:
    """The file of a frame log, or a flight record by its suffix; it may not exist yet."""
    return SqliteFile(path, FLIGHT_RECORD if path.suffix == FLIGHT_SUFFIX else FRAME_LOG)


def begin_writing(connection: Connection) -> None:
    """Takes the file's write lock; readers still see the last commit."""
    connection.exec_driver_sql("BEGIN IMMEDIATE")


def log_while_writing(connection: Connection) -> None:
    """Switches to a write-ahead log, so that commits survive the process; outside a transaction."""
    connection.exec_driver_sql("PRAGMA journal_mode = WAL")
    connection.exec_driver_sql("PRAGMA synchronous = NORMAL")


def fold_log_in(connection: Connection) -> None:
    """Merges the write-ahead log into the file, for read-only media; outside a transaction.

    If a reader has the file open, the next writer does it.
    """
    try:
        connection.exec_driver_sql("PRAGMA journal_mode = DELETE")
    except OperationalError as error:
        code = getattr(error.orig, "sqlite_errorcode", 0) & 0xFF
        if code not in {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}:
            raise


_CAMERA_NUMBERS = ("fx", "fy", "cx", "cy", "baseline_m")
_CAMERA_SIZES = ("width", "height")


@dataclass(frozen=True, slots=True)
class FrameLogHeader:
    """Facts common to all frames of a log.

    Attributes:
        info: facts of the drive; `format` names the layout of its images.
        frontend: hash of the front-end's version and configuration.
        odometry: hash of the odometry's version and configuration.
        frames: which frames of the source were recorded, `str` of a `FrameRange`.
    """

    info: SequenceInfo
    camera: StereoCamera
    descriptor: DescriptorKind
    frontend: str
    odometry: str = ""
    frames: str = ""

    def to_json(self) -> str:
        """Canonical: equal headers give equal text."""
        camera = self.camera
        values = {
            "name": self.info.name,
            "source_format": self.info.format,
            "clock": self.info.clock.value,
            "robot": self.info.robot,
            "longitude_deg": self.info.longitude_deg,
            "zone": self.info.zone,
            "descriptor": self.descriptor,
            "frontend": self.frontend,
            "odometry": self.odometry,
            "frames": self.frames,
            "camera": {
                **{name: float(getattr(camera, name)) for name in _CAMERA_NUMBERS},
                **{name: int(getattr(camera, name)) for name in _CAMERA_SIZES},
                "rectification": camera.rectification,
                "cam_from_rig": (
                    None
                    if camera.cam_from_rig is None
                    else camera.cam_from_rig.matrix()[:3].ravel().tolist()
                ),
                "id": camera.id,
            },
        }
        return json.dumps(values, sort_keys=True)

    @staticmethod
    def from_json(text: str) -> FrameLogHeader:
        """Undo `to_json`."""
        try:
            values = json.loads(text)
            camera = _camera(values["camera"])
            info = SequenceInfo(
                _text(values["name"]),
                _text(values["source_format"]),
                Clock(values["clock"]),
                None if values["robot"] is None else _text(values["robot"]),
                None if values["longitude_deg"] is None else float(values["longitude_deg"]),
                None if values["zone"] is None else _text(values["zone"]),
            )
            check_longitude(info.longitude_deg)
            if info.zone is not None and not is_zone_name(info.zone):
                raise ValueError(f"{info.zone!r:.40} is not a time zone")
            return FrameLogHeader(
                info,
                camera,
                feature_kind(_text(values["descriptor"])).name,
                _text(values["frontend"]),
                _text(values["odometry"]),
                _text(values["frames"]),
            )
        except IncompatibleError:
            raise
        except (ValueError, KeyError, TypeError, RecursionError, EngramError) as error:
            raise MapCorruptError(f"the frame log's header cannot be read: {error}") from error


def _camera(values: dict[str, Any]) -> StereoCamera:
    mounting = values["cam_from_rig"]
    # Not projected onto SO(3) again: the last bits count for the camera's id.
    matrix = None if mounting is None else np.array(mounting, dtype=np.float64).reshape(3, 4)
    camera = StereoCamera(
        **{name: float(values[name]) for name in _CAMERA_NUMBERS},
        width=int(values["width"]),
        height=int(values["height"]),
        cam_from_rig=None if matrix is None else SE3(matrix[:, :3].copy(), matrix[:, 3].copy()),
        rectification=_text(values["rectification"]),
    )
    if camera.id != values["id"]:
        raise ValueError(f"camera {values['id']} does not match its values")
    return camera


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value


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
        pair_hash: `first_pair_hash` of the frame's images.
        odometry: ``prev_from_curr`` since the frame before, with its covariance.
    """

    number: int
    stamp_ns: int
    status: FrameStatus
    pair_hash: str
    odometry: OdometryStep


def encode_row(number: int, logged: LoggedFrame, pair_hash: str) -> dict[str, Any]:
    """The row of a frame."""
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
    """A row selected by `STEP_COLUMNS`."""
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
    """The frame of a row."""
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


def encode_more(
    row: dict[str, Any], frame: Frame, ranked: RankedLandmarks
) -> dict[str, Any] | None:
    """The row of the further landmarks of a frame.

    Args:
        row: `encode_row` of the frame.

    Returns:
        None where the first of them are not the frame's: some of it were left out.
    """
    own, more = ranked.parted(len(frame.landmarks))
    if encode_landmarks(own, frame.camera) != row["landmarks"]:
        return None
    values = {
        "number": row["number"],
        "ranks": ranked.ranks.astype("<u2").tobytes(),
        "landmarks": encode_landmarks(more, frame.camera),
    }
    return {**values, "digest": _more_digest(values, row["digest"])}


def decode_more(row: Any, step_digest: bytes, frame: Frame) -> RankedLandmarks:
    """A row of `more_table`, and the frame that it belongs to."""
    values = dict(row._mapping)
    try:
        if not all(isinstance(values[name], bytes) for name in ("ranks", "landmarks", "digest")):
            raise ValueError("is not of its types")
        if _more_digest(values, step_digest) != values["digest"]:
            raise ValueError("do not match their hash")
        more = decode_landmarks(values["landmarks"], frame.camera, frame.descriptor)
        ranks = np.frombuffer(values["ranks"], dtype="<u2").astype(np.uint16)
        return RankedLandmarks.joined(frame.landmarks, more, ranks)
    except (ValueError, MapCorruptError) as error:
        raise MapCorruptError(
            f"frame {values['number']} of the frame log: its further landmarks: {error}"
        ) from error


def _more_digest(values: dict[str, Any], step_digest: bytes) -> bytes:
    return content_digest(step_digest + values["ranks"] + values["landmarks"][:HASH_BYTES])


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
