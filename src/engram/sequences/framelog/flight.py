"""Flight records: a frame log of a robot's last seconds, with its decisions and images.

`FrameLog` reads such a file as a drive. Decisions and images are for people.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, func, insert, select

from engram.errors import MapCorruptError, SequenceError
from engram.frontend.blobs import content_digest
from engram.sequences.framelog.file import (
    decisions_table,
    framelog_file,
    images_table,
    report_table,
)
from engram.sequences.framelog.reader import read_header
from engram.sequences.framelog.writer import FrameLogWriter
from engram.sequences.images import decoded, grey, header_size

# Keys of the report: how many decisions, and images, belong to it.
_FRAMES, _IMAGES = "frames", "images"


class FlightWriter(FrameLogWriter):
    """Writes a flight record, NAME.flight. Each frame is appended, then what belongs to it."""

    def add_report(self, content: Mapping[str, Any], *, frames: int, images: int) -> None:
        """Stores why and where the record was made.

        Args:
            content: plain JSON data.
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
    """Why and where a record was made.

    Raises:
        SequenceError: the file is not a flight record.
        MapCorruptError: it is damaged.
    """
    with _reading(path) as connection:
        return _report(path, connection)


def read_decisions(path: Path) -> dict[int, dict[str, Any]]:
    """What the robot concluded from each frame, by its number; see `read_report` for errors."""
    with _reading(path) as connection:
        rows = connection.execute(select(decisions_table).order_by(decisions_table.c.number))
        found = {row.number: _json(path, row) for row in rows}
        _check_count(path, len(found), _report(path, connection), _FRAMES)
        return found


def read_images(path: Path, number: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]] | None:
    """Left and right image (h, w) uint8 of a frame; None if the record has none.

    Raises:
        SequenceError: the file is not a flight record.
        MapCorruptError: it is damaged.
    """
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
    if not all(isinstance(one, bytes) for one in sides) or content_digest(b"".join(sides)) != (
        row.digest
    ):
        raise MapCorruptError(f"{path}: the images of frame {number} do not match their hash")
    size = (header.camera.width, header.camera.height)
    left, right = (_decoded(path, one, size) for one in sides)
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
    """The report of a record, which has one.

    Raises:
        MapCorruptError: it has none, or it is damaged.
    """
    row = connection.execute(select(report_table).order_by(report_table.c.key)).first()
    if row is None:
        raise MapCorruptError(f"{path}: the flight record has lost its report")
    return _json(path, row)


def _check_count(path: Path, stored: int, report: Mapping[str, Any], name: str) -> None:
    """Compares the rows that are stored with those that the report counts.

    Raises:
        MapCorruptError: they differ. Records of before Engram counted them are not compared.
    """
    counted = report.get(name, stored)
    if stored != counted:
        raise MapCorruptError(
            f"{path}: the flight record has {stored} {name}, and was written with {counted}"
        )


def _json(path: Path, row: Any) -> dict[str, Any]:
    """The content of a row.

    Raises:
        MapCorruptError: it does not match its hash, or is not an object.
    """
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
