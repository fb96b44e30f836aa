"""Reads a frame log as a drive: all frames, a range, or every n-th frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, select

from engram.errors import ConfigError, MapCorruptError, SequenceError
from engram.frontend.frame import Frame, Landmarks
from engram.frontend.ranked import RankedLandmarks
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import propagate_covariance
from engram.odometry.outside import MotionSource
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.sequences.framelog.file import (
    FLIGHT_SUFFIX,
    STEP_COLUMNS,
    FrameLogHeader,
    StepRow,
    decode_frame,
    decode_more,
    decode_step,
    framelog_file,
    frames_table,
    log_digest,
    log_table,
    more_table,
)
from engram.sequences.layouts import with_options
from engram.sequences.motion_files import motion_of_files
from engram.sequences.sequence import Channel, LoggedFrame, OpenOptions, SequenceInfo

SUFFIX = ".framelog"


def is_framelog(path: Path) -> bool:
    """A file named `….framelog`, or `….flight`: the log of a robot's last seconds.

    Its bytes are not read: opening and closing a file that this process also writes through
    SQLite would drop SQLite's locks.
    """
    return path.suffix in {SUFFIX, FLIGHT_SUFFIX} and path.is_file()


def open_framelog(path: Path, options: OpenOptions) -> FrameLog:
    """A frame log as a drive; `FrameLog` lists other errors."""
    if options.channel is not Channel.GREY:
        raise ConfigError(
            f"{path}: a frame log has no images with a channel {options.channel.value!r}; "
            "choose the channel when recording it"
        )
    for option, value in (
        ("--calibration", options.calibration),
        ("drive.field_of_view_deg", options.field_of_view_deg),
        ("drive.mask", options.mask),
    ):
        if value is not None:
            raise ConfigError(f"{path}: a frame log has no images: give {option} when recording it")
    return FrameLog(path, options)


class FrameLog:
    """A frame log as a drive of frames with odometry, decoded on demand.

    With a range of frames, odometry is composed over the frames left out; if one of those steps
    failed, the composed step fails too. With `skip_bad`, damaged frames are left out, too, and
    counted.

    Args:
        landmarks: of each frame, the first so many of those that the log keeps; None for the
            front-end's own. Odometry stays that of its own.
    """

    def __init__(
        self, path: str | Path, options: OpenOptions | None = None, landmarks: int | None = None
    ) -> None:
        self._path = Path(path)
        self._landmarks = landmarks
        options = options or OpenOptions()
        self._file = framelog_file(self._path)
        self._file.check_regular()
        self._engine = self._file.engine("mode=ro")
        try:
            with self._file.errors(), self._engine.connect() as connection:
                self._file.identify(connection.exec_driver_sql)
                self._file.check_tables(connection.exec_driver_sql)
                self._header, counted = read_header(connection)
                stamps_ns, self._usable = _read_stamps(connection)
                if counted not in {0, len(stamps_ns)}:
                    raise MapCorruptError(
                        f"the log has {len(stamps_ns)} frames, and was recorded with {counted}"
                    )
                self._complete = counted > 0
        except MapCorruptError as error:
            raise self._named(error) from error
        self._info = with_options(self._header.info, options)
        first_ns = int(stamps_ns[0]) if len(stamps_ns) else 0
        self._numbers = [
            number
            for number in options.frames.indices(len(stamps_ns))
            if options.times.holds(int(stamps_ns[number]), first_ns)
        ]
        if not self._numbers:
            raise SequenceError(
                f"{self._path}: none of the {len(stamps_ns)} frames in the log is chosen "
                f"(frames {options.frames})"
            )
        at_ns = options.recorded_at_ns
        shift_ns = 0 if at_ns is None else at_ns - int(stamps_ns[0])
        self._shift_ns = shift_ns
        self._stamps_ns = stamps_ns[list(self._numbers)] + shift_ns
        self._motion_files = options.motion
        self.motion()  # so that a file that cannot be used is known at once
        self._skip_bad = options.skip_bad
        self._skipped_reasons: list[str] = []

    @property
    def path(self) -> Path:
        """The log."""
        return self._path

    @property
    def info(self) -> SequenceInfo:
        """Facts about the drive as a whole; `format` is "framelog"."""
        return replace(self._info, format="framelog")

    @property
    def header(self) -> FrameLogHeader:
        """The header, as recorded."""
        return self._header

    @property
    def camera(self) -> StereoCamera:
        """The one camera of the drive."""
        return self._header.camera

    def motion(self) -> MotionSource | None:
        """A new pass through the motion of the caller's files; None without one."""
        return motion_of_files(self._motion_files, self.camera.cam_from_rig, self._shift_ns)

    @property
    def complete(self) -> bool:
        """Whether the drive was recorded to its end; False after an interruption."""
        return self._complete

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """(N,) int64 stamps of the chosen frames, ns."""
        return self._stamps_ns

    @property
    def first_pair_hash(self) -> str:
        """`first_pair_hash` of the images of the first chosen frame (method §2.7)."""
        return self.pair_hash(0)

    def pair_hash(self, index: int) -> str:
        """`first_pair_hash` of the images of a chosen frame."""
        number = self._numbers[index]
        with self._file.errors(), self._engine.connect() as connection:
            return next(self._steps(connection, number, number)).pair_hash

    @property
    def skipped(self) -> int:
        """Frames left out as damaged under `skip_bad`, in the latest pass through the log."""
        return len(self._skipped_reasons)

    @property
    def skipped_reasons(self) -> list[str]:
        """Why each of the `skipped` frames was left out."""
        return list(self._skipped_reasons)

    def ranked(self, index: int) -> RankedLandmarks | None:
        """All landmarks that are kept of a chosen frame; None where there are no further ones."""
        return self._ranked_of(self._numbers[index])

    def _ranked_of(self, number: int) -> RankedLandmarks | None:
        try:
            with self._file.errors(), self._engine.connect() as connection:
                row, step = self._frame_row(connection, number)
                frame = decode_frame(step, row.landmarks, row.thumbnail, self._header)
                return self._ranked(connection, row.digest, frame, number)
        except MapCorruptError as error:
            raise self._named(error) from error

    def _further(self, number: int, own: int, count: int) -> Landmarks:
        """The landmarks of a frame after its own, up to `count` in all; see `Frame.further`."""
        ranked = self._ranked_of(number)
        if ranked is None:
            return self._read(number, None).frame.landmarks.rows(slice(0))
        return ranked.further(own, count)

    def _ranked(
        self, connection: Connection, step_digest: bytes, frame: Frame, number: int
    ) -> RankedLandmarks | None:
        if "more" not in self._file.kind.metadata.tables:
            return None
        query = select(more_table).where(more_table.c.number == number)
        row = connection.execute(query.order_by(more_table.c.number)).one_or_none()
        return None if row is None else decode_more(row, step_digest, frame)

    def close(self) -> None:
        """Closes the file; the next access opens it again."""
        self._engine.dispose()

    def __len__(self) -> int:
        return len(self._numbers)

    def __iter__(self) -> Iterator[LoggedFrame]:
        """The chosen frames in the order of time."""
        self._skipped_reasons.clear()
        previous: int | None = None
        for number in self._numbers:
            try:
                logged = self._read(number, previous)
            except MapCorruptError as error:
                if not self._skip_bad:
                    raise MapCorruptError(
                        f"{error}; leave it out with --set drive.skip_bad=true"
                    ) from error
                self._skipped_reasons.append(str(error))
                continue
            if logged.odometry.status is not OdometryStatus.UNUSABLE_FRAME:
                previous = number
            yield logged

    def read(self, index: int) -> LoggedFrame:
        """Frame `index` of `len(self)`, with the motion since the chosen frame before it."""
        index = range(len(self._numbers))[index]
        usable = (number for number in self._numbers[:index][::-1] if self._usable[number])
        return self._read(self._numbers[index], next(usable, None))

    def _read(self, number: int, previous: int | None) -> LoggedFrame:
        """A frame with the motion since `previous`, the last usable chosen frame."""
        try:
            with self._file.errors(), self._engine.connect() as connection:
                row, step = self._frame_row(connection, number)
                frame = decode_frame(step, row.landmarks, row.thumbnail, self._header)
                if self._landmarks is not None:
                    ranked = self._ranked(connection, row.digest, frame, number)
                    if ranked is not None:
                        frame = replace(frame, landmarks=ranked.first(self._landmarks))
                if "more" in self._file.kind.metadata.tables:
                    further = partial(self._further, number, len(frame.landmarks))
                    frame = replace(frame, further=further)
                odometry = self._motion(connection, previous, step)
        except MapCorruptError as error:
            raise self._named(error) from error
        return LoggedFrame(replace(frame, stamp_ns=frame.stamp_ns + self._shift_ns), odometry)

    def _frame_row(self, connection: Connection, number: int) -> tuple[Any, StepRow]:
        columns = (*STEP_COLUMNS, frames_table.c.landmarks, frames_table.c.thumbnail)
        row = connection.execute(
            select(*columns).where(frames_table.c.number == number).order_by(frames_table.c.number)
        ).one_or_none()
        if row is None:
            raise MapCorruptError(f"frame {number} is missing")
        return row, decode_step(row)

    def _motion(self, connection: Connection, previous: int | None, last: StepRow) -> OdometryStep:
        """Motion of a frame since `previous`, composed over the frames between them."""
        if last.odometry.status is OdometryStatus.UNUSABLE_FRAME:
            return last.odometry
        if previous is None:
            return OdometryStep(OdometryStatus.FIRST)
        composed: OdometryStep | None = None
        if last.number - previous > 1:
            try:
                for step in self._steps(connection, previous + 1, last.number - 1):
                    composed = compose(composed, step.odometry)
            except MapCorruptError:
                if not self._skip_bad:
                    raise
                # The motion over a damaged row is unknown.
                return OdometryStep(OdometryStatus.NO_CONSENSUS)
        return compose(composed, last.odometry)

    def _steps(self, connection: Connection, first: int, last: int) -> Iterator[StepRow]:
        query = (
            select(*STEP_COLUMNS)
            .where(frames_table.c.number.between(first, last))
            .order_by(frames_table.c.number)
        )
        for row in connection.execute(query):
            yield decode_step(row)

    def _named(self, error: MapCorruptError) -> MapCorruptError:
        text = str(error)
        return (
            error if text.startswith(str(self._path)) else MapCorruptError(f"{self._path}: {text}")
        )


def compose(first: OdometryStep | None, second: OdometryStep) -> OdometryStep:
    """Composes two successive steps; if either failed, so does the result.

    An unusable frame between them is skipped: the step after it spans it (`OdometryStep`). The
    covariance is first order with independent errors; the inliers are the smaller of the two.
    """
    if first is None or first.status is OdometryStatus.UNUSABLE_FRAME:
        return second
    if second.status is OdometryStatus.UNUSABLE_FRAME or first.status is not OdometryStatus.OK:
        return first
    if second.status is not OdometryStatus.OK:
        return second
    assert first.prev_from_curr is not None
    assert first.covariance is not None
    assert second.prev_from_curr is not None
    assert second.covariance is not None
    return OdometryStep(
        OdometryStatus.OK,
        first.prev_from_curr @ second.prev_from_curr,
        propagate_covariance(first.prev_from_curr, first.covariance, second.covariance),
        min(first.inliers, second.inliers),
    )


def read_header(connection: Connection) -> tuple[FrameLogHeader, int]:
    """Header of a log, and its number of frames: 0 before it is complete."""
    rows = connection.execute(select(log_table).order_by(log_table.c.key)).all()
    if (
        len(rows) != 1
        or not isinstance(rows[0].header, str)
        or not isinstance(rows[0].complete, int)
        or log_digest(rows[0].header, rows[0].complete) != rows[0].digest
    ):
        raise MapCorruptError("the frame log's header is missing or does not match its hash")
    return FrameLogHeader.from_json(rows[0].header), rows[0].complete


def _read_stamps(connection: Connection) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """(F,) int64 stamps of all frames, ns, and (F,) bool, whether odometry could use them."""
    columns = frames_table.c
    query = select(columns.number, columns.stamp_ns, columns.odometry_status)
    rows = connection.execute(query.order_by(columns.number)).all()
    if not rows:
        raise SequenceError("the frame log holds no frame")
    if not all(isinstance(value, int) for row in rows for value in row[:2]):
        raise MapCorruptError("the frame log has stamps that are not numbers")
    table = np.array([row[:2] for row in rows], dtype=np.int64).reshape(-1, 2)
    if (table[:, 0] != np.arange(len(table))).any():
        raise MapCorruptError("frames are missing in the frame log: their numbers have gaps")
    if (np.diff(table[:, 1]) <= 0).any():
        raise MapCorruptError("the frame log's stamps do not increase")
    usable = [row.odometry_status != OdometryStatus.UNUSABLE_FRAME.value for row in rows]
    return table[:, 1].copy(), np.array(usable)
