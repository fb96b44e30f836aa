"""Records a frame log with checkpoints; continues after an interruption."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

from sqlalchemy import Connection, func, insert, select, update

from engram import __version__
from engram.errors import IncompatibleError, InputError, MapError
from engram.sequences.framelog.file import (
    begin_writing,
    fold_log_in,
    framelog_file,
    frames_table,
    log_digest,
    log_table,
    log_while_writing,
)
from engram.sequences.framelog.header import FrameLogHeader
from engram.sequences.framelog.reader import read_header
from engram.sequences.framelog.rows import encode_row
from engram.sequences.sequence import LoggedFrame


class FrameLogWriter:
    """The one writer of a frame log. A context manager: leaving it commits and closes.

    Left without an exception, the log is marked complete. A killed process loses at most
    the frames since the last checkpoint; a writer on the same path continues after
    `last_stamp_ns`.

    Args:
        path: the file, created if missing.
        header: facts common to all frames.
        checkpoint_every: frames between commits. 50: commits cost under 1 % of the
            front-end's time, and at most 5 s of a 10 Hz drive are lost.

    Raises:
        IncompatibleError: the file holds another drive's log, or one made with other settings.
        InputError: the file is not a frame log, or its folder does not exist.
        MapLockedError: another writer has it open.
        MapError: as `FrameLog`, and `StorageFullError`.
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

    def append(self, logged: LoggedFrame, pair_hash: str) -> None:
        """Record the next frame.

        Args:
            logged: the frame, of the header's camera, front-end and descriptor kind.
            pair_hash: `first_pair_hash` of its images, for the identity of sessions that begin
                with this frame.

        Raises:
            InputError: the frame is not after the last one, or does not fit the header.
            StorageFullError: no space is left.
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
        with self._or_abandon() as connection:
            connection.execute(insert(frames_table), row)
        self._recorded += 1
        self._last_stamp_ns = frame.stamp_ns
        self._since_checkpoint += 1
        if self._since_checkpoint >= self._checkpoint_every:
            self.checkpoint()

    def holds(self, stamp_ns: int, pair_hash: str) -> bool:
        """Whether an earlier run recorded this frame, so that it is skipped.

        Raises:
            IncompatibleError: other images are recorded at its place: the log is that of another
                drive, rig, channel or choice of frames.
        """
        if self._last_stamp_ns is None or stamp_ns > self._last_stamp_ns:
            return False
        with self._or_abandon() as connection:
            found = connection.execute(
                select(frames_table.c.pair_hash)
                .where(frames_table.c.stamp_ns == stamp_ns)
                .order_by(frames_table.c.number)
            ).scalar()
        if found != pair_hash:
            raise IncompatibleError(
                f"{self._path}: holds {'other images' if found else 'no frame'} at {stamp_ns} ns: "
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
