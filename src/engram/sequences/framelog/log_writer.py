"""Records frame logs, and the flight records of a robot's last seconds.

Flight records: a frame log of a robot's last seconds, with its decisions and images. `FrameLog`
reads such a file as a drive. Decisions and images are for people.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, func, insert, select, update

from engram import __version__
from engram.errors import IncompatibleError, InputError, MapCorruptError, MapError, SequenceError
from engram.frontend.blobs import content_digest
from engram.frontend.ranked import RankedLandmarks
from engram.sequences.framelog.file import (
    FrameLogHeader,
    begin_writing,
    decisions_table,
    encode_more,
    encode_row,
    fold_log_in,
    framelog_file,
    frames_table,
    images_table,
    log_digest,
    log_table,
    log_while_writing,
    more_table,
    report_table,
)
from engram.sequences.framelog.reader import read_header
from engram.sequences.images import decoded, grey, header_size
from engram.sequences.sequence import LoggedFrame


class FrameLogWriter:
    """The one writer of a frame log. A context manager: leaving it commits and closes.

    Left without an exception, the log is marked complete. A killed process loses at most
    the frames since the last checkpoint; a writer on the same path continues after
    `last_stamp_ns`.

    Args:
        checkpoint_every: frames between commits. 50: commits cost under 1 % of the
            front-end's time, and at most 5 s of a 10 Hz drive are lost.
    """

    def __init__(
        self, path: str | Path, header: FrameLogHeader, checkpoint_every: int = 50
    ) -> None:
        if checkpoint_every < 1:
            raise InputError(f"checkpoint every {checkpoint_every} frames, must be >= 1")
        self._path = Path(path)
        self._header = header
        self._checkpoint_every = checkpoint_every
        self._since_checkpoint = 0
        self._file = framelog_file(self._path)
        self._file.check_regular(may_be_new=True)
        self._engine = self._file.engine("mode=rwc")
        self._connection: Connection | None = None
        self._recorded, self._last_stamp_ns = 0, None
        try:
            with self._file.errors():
                self._connection = self._engine.connect()
                self._recorded, self._last_stamp_ns = self._begin(self._connection)
        except BaseException:
            self._abandon()
            raise

    @property
    def recorded(self) -> int:
        """Frames in the log, those of earlier runs included; the next one gets this number."""
        return self._recorded

    @property
    def last_stamp_ns(self) -> int | None:
        """Stamp of the last frame in the log; None while it is empty."""
        return self._last_stamp_ns

    def append(
        self, logged: LoggedFrame, pair_hash: str, ranked: RankedLandmarks | None = None
    ) -> None:
        """Record the next frame.

        Args:
            logged: the frame, of the header's camera, front-end and descriptor kind.
            pair_hash: `first_pair_hash` of its images, for the identity of sessions that begin
                with this frame.
            ranked: its landmarks and further ones, not kept where some of its own were left out.
        """
        frame, header = logged.frame, self._header
        for name in ("camera", "descriptor", "frontend"):
            if getattr(frame, name) != getattr(header, name):
                raise InputError(f"{self._path}: a frame of another {name} than the log's")
        if self._last_stamp_ns is not None and frame.stamp_ns <= self._last_stamp_ns:
            raise InputError(
                f"{self._path}: frame stamped {frame.stamp_ns} ns is not after the last one "
                f"({self._last_stamp_ns} ns)"
            )
        row = encode_row(self._recorded, logged, pair_hash)
        more = None if ranked is None else encode_more(row, frame, ranked)
        with self._or_abandon() as connection:
            connection.execute(insert(frames_table), row)
            if more is not None:
                connection.execute(insert(more_table), more)
        self._recorded += 1
        self._last_stamp_ns = frame.stamp_ns
        self._since_checkpoint += 1
        if self._since_checkpoint >= self._checkpoint_every:
            self.checkpoint()

    def holds(self, stamp_ns: int, pair_hash: str) -> bool:
        """Whether an earlier run recorded this frame, so that it is skipped."""
        if self._last_stamp_ns is None or stamp_ns > self._last_stamp_ns:
            return False
        with self._or_abandon() as connection:
            stored = connection.execute(
                select(frames_table.c.pair_hash)
                .where(frames_table.c.stamp_ns == stamp_ns)
                .order_by(frames_table.c.number)
            ).scalar()
        if stored != pair_hash:
            raise IncompatibleError(
                f"{self._path}: holds {'other images' if stored else 'no frame'} at {stamp_ns} ns: "
                "it is the log of another drive, rig, channel or choice of frames; choose another "
                "file or remove it"
            )
        return True

    def checkpoint(self) -> None:
        """Commits all appended frames, so that they survive the process."""
        with self._or_abandon() as connection:
            connection.commit()
            # Begun again at once, so that no other writer comes between two checkpoints.
            begin_writing(connection)
        self._since_checkpoint = 0

    def close(self, *, complete: bool = False) -> None:
        """Commits and closes; `complete` marks the end of the drive. Closing twice is allowed.

        After a file error the writer is closed already, as of its last checkpoint.
        """
        connection = self._connection
        if connection is None:
            return
        try:
            with self._file.errors():
                self._mark(connection, self._recorded if complete else 0)
                connection.commit()
                fold_log_in(connection)
        finally:
            self._abandon()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close(complete=kind is None)

    def _begin(self, connection: Connection) -> tuple[int, int | None]:
        """Creates or opens the log; returns the number of its frames and the stamp of the last."""
        run = connection.exec_driver_sql
        if not self._file.is_new(run):
            self._file.identify(run)
            self._file.check_tables(run)
        connection.rollback()
        log_while_writing(connection)
        begin_writing(connection)
        if self._file.is_new(run):
            self._make(connection)
            return 0, None
        found, complete = read_header(connection)
        if found.to_json() != self._header.to_json():
            raise IncompatibleError(
                f"{self._path}: holds the log of another drive, or one made with another camera, "
                "front-end, odometry or choice of frames; choose another file or remove it"
            )
        if complete:
            self._mark(connection, 0)  # until it is closed: what is appended is not counted yet
        count, last_ns = connection.execute(
            select(func.count(), func.max(frames_table.c.stamp_ns)).select_from(frames_table)
        ).one()
        return int(count), last_ns

    def _make(self, connection: Connection) -> None:
        self._file.kind.metadata.create_all(connection)
        self._file.mark(connection.exec_driver_sql)
        header = self._header.to_json()
        connection.execute(
            insert(log_table),
            {
                "key": 1,
                "header": header,
                "tool_version": __version__,
                "complete": 0,
                "digest": log_digest(header, 0),
            },
        )
        connection.commit()
        begin_writing(connection)

    def _mark(self, connection: Connection, complete: int) -> None:
        """Writes how many frames a complete log has, or 0."""
        self._file.mark(connection.exec_driver_sql)
        digest = log_digest(self._header.to_json(), complete)
        connection.execute(update(log_table).values(complete=complete, digest=digest))

    @contextmanager
    def _or_abandon(self) -> Iterator[Connection]:
        """The connection; after an SQLite error the writer is closed as of its last checkpoint.

        SQLite may have rolled back the transaction, and then this writer's counts are wrong.
        """
        if self._connection is None:
            raise InputError(f"{self._path}: this writer is closed")
        try:
            with self._file.errors():
                yield self._connection
        except MapError:
            self._abandon()
            raise

    def _abandon(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        self._engine.dispose()


# Keys of the report: how many decisions, and images, belong to it.
_FRAMES, _IMAGES = "frames", "images"


class FlightWriter(FrameLogWriter):
    """Writes a flight record, NAME.flight. Each frame is appended, then what belongs to it."""

    def add_report(self, content: Mapping[str, Any], *, frames: int, images: int) -> None:
        """Stores why and where the record was made.

        Args:
            frames, images: how many frames, and of how many the images, will be added: so that a
                reader finds out what is gone.
        """
        text = json.dumps({**content, _FRAMES: frames, _IMAGES: images})
        with self._or_abandon() as connection:
            row = {"key": 1, "content": text, "digest": content_digest(text.encode())}
            connection.execute(insert(report_table), row)

    def add_decision(self, content: Mapping[str, Any]) -> None:
        """Stores what the robot concluded from the frame that was appended last."""
        text = json.dumps(content)
        row = {"number": self.recorded - 1, "content": text}
        with self._or_abandon() as connection:
            connection.execute(
                insert(decisions_table), {**row, "digest": content_digest(text.encode())}
            )

    def add_images(self, left: bytes, right: bytes) -> None:
        """Stores the images, JPEG, of the frame that was appended last."""
        row = {"number": self.recorded - 1, "left_image": left, "right_image": right}
        with self._or_abandon() as connection:
            connection.execute(
                insert(images_table), {**row, "digest": content_digest(left + right)}
            )


def read_report(path: Path) -> dict[str, Any]:
    """Why and where a record was made."""
    with _reading(path) as connection:
        return _report(path, connection)


def read_decisions(path: Path) -> dict[int, dict[str, Any]]:
    """What the robot concluded from each frame, by its number; see `read_report` for errors."""
    with _reading(path) as connection:
        rows = connection.execute(select(decisions_table).order_by(decisions_table.c.number))
        decisions = {row.number: _json(path, row) for row in rows}
        _check_count(path, len(decisions), _report(path, connection), _FRAMES)
        return decisions


def read_images(path: Path, number: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]] | None:
    """Left and right image (h, w) uint8 of a frame; None if the record has none."""
    with _reading(path) as connection:
        columns = images_table.c
        query = select(images_table).where(columns.number == number).order_by(columns.number)
        row = connection.execute(query).first()
        stored = connection.execute(select(func.count()).select_from(images_table)).scalar_one()
        _check_count(path, stored, _report(path, connection), _IMAGES)
        header, frames = read_header(connection)
    if row is None:
        if stored == frames:
            raise MapCorruptError(f"{path}: the images of frame {number} are not found")
        return None
    sides = (row.left_image, row.right_image)
    if not all(isinstance(side, bytes) for side in sides) or content_digest(b"".join(sides)) != (
        row.digest
    ):
        raise MapCorruptError(f"{path}: the images of frame {number} do not match their hash")
    size = (header.camera.width, header.camera.height)
    left, right = (_decoded(path, side, size) for side in sides)
    return left, right


@contextmanager
def _reading(path: Path) -> Iterator[Connection]:
    file = framelog_file(path)
    file.check_regular()
    engine = file.engine("mode=ro")
    try:
        with file.errors(), engine.connect() as connection:
            file.identify(connection.exec_driver_sql)
            file.check_tables(connection.exec_driver_sql)
            yield connection
    finally:
        engine.dispose()


def _report(path: Path, connection: Connection) -> dict[str, Any]:
    row = connection.execute(select(report_table).order_by(report_table.c.key)).first()
    if row is None:
        raise MapCorruptError(f"{path}: the flight record has lost its report")
    return _json(path, row)


def _check_count(path: Path, stored: int, report: Mapping[str, Any], name: str) -> None:
    """Compares the rows that are stored with those that the report counts."""
    counted = report.get(name, stored)
    if stored != counted:
        raise MapCorruptError(
            f"{path}: the flight record has {stored} {name}, and was written with {counted}"
        )


def _json(path: Path, row: Any) -> dict[str, Any]:
    try:
        if content_digest(row.content.encode()) != row.digest:
            raise ValueError("does not match its hash")
        content = json.loads(row.content)
        if not isinstance(content, dict):
            raise ValueError("is not an object")
    except (ValueError, AttributeError, RecursionError) as error:
        raise MapCorruptError(f"{path}: an entry of the flight record {error}") from error
    return content


def _decoded(path: Path, content: bytes, size: tuple[int, int]) -> NDArray[np.uint8]:
    if header_size(content) != size:
        raise MapCorruptError(f"{path}: an image is not {size[0]}×{size[1]} px")
    try:
        return grey(path, decoded(path, content, size))
    except SequenceError as error:
        raise MapCorruptError(str(error)) from error
