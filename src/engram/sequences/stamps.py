"""Files of stamps: decimal seconds, dates, nanoseconds; all exact, as whole nanoseconds."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path

from engram.errors import CalibrationError, SequenceError

# Text files beside images; the longest real one (an hour of ROS images at 100 Hz) has 20 MB.
_MAX_TEXT_BYTES = 100_000_000
# Beyond the year 2200 a stamp no longer fits into 64 bits: nothing that was driven.
_MAX_STAMP_NS = 2**63 - 1

_SECONDS = re.compile(r"[+-]?\d{1,12}(\.\d{0,30})?([eE][+-]?\d{1,2})?", re.ASCII)
_NANOSECONDS = re.compile(r"\d{1,19}", re.ASCII)
_DATE = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(?:\.(\d{1,12}))?Z?", re.ASCII)


def read_text(path: Path) -> str:
    """A text file beside the images.

    Raises:
        SequenceError: it is missing, unreadable, too large, or no UTF-8 text.
    """
    try:
        size = path.stat().st_size
        if size > _MAX_TEXT_BYTES:
            raise SequenceError(f"{path}: {size} bytes, at most {_MAX_TEXT_BYTES} are read")
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise SequenceError(f"{path}: the file is missing") from None
    except UnicodeDecodeError as error:
        raise SequenceError(f"{path}: no text at byte {error.start}") from error
    except OSError as error:
        raise SequenceError(f"{path}: cannot be read: {error.strerror}") from error


def read_calibration_text(path: Path) -> str:
    """As `read_text`, for a calibration.

    Raises:
        CalibrationError: it is missing, unreadable, too large, or no UTF-8 text.
    """
    try:
        return read_text(path)
    except SequenceError as error:
        raise CalibrationError(str(error)) from error


def read_stamps(path: Path, parse: Callable[[str], int | None]) -> list[int]:
    """The stamps of a file with one stamp a line, ns. Empty lines at the end do not count.

    Raises:
        SequenceError: as `read_text`; a line is no stamp, or there is none at all.
    """
    lines = read_text(path).rstrip().splitlines()
    stamps_ns: list[int] = []
    for number, line in enumerate(lines, start=1):
        stamp_ns = parse(line.strip())
        if stamp_ns is None:
            raise SequenceError(f"{path}: line {number} is no stamp: {line[:60]!r}")
        stamps_ns.append(stamp_ns)
    if not stamps_ns:
        raise SequenceError(f"{path}: holds no stamp")
    return stamps_ns


def seconds_as_ns(text: str) -> int | None:
    """Decimal seconds, such as `1.044989e-01`; None if the text is none."""
    if not _SECONDS.fullmatch(text):
        return None
    return _in_range(int((Decimal(text) * 1_000_000_000).to_integral_value()))


def nanoseconds(text: str) -> int | None:
    """Whole nanoseconds; None if the text is none."""
    return _in_range(int(text)) if _NANOSECONDS.fullmatch(text) else None


def date_as_ns(text: str) -> int | None:
    """A UTC date such as `2011-09-26 13:02:25.967790592` as ns since 1970; None if it is none."""
    match = _DATE.fullmatch(text)
    if not match:
        return None
    day, time, fraction = match.groups()
    try:
        whole = datetime.fromisoformat(f"{day}T{time}").replace(tzinfo=UTC)
    except ValueError:
        return None
    nanos = int((fraction or "0").ljust(9, "0")[:9])
    return _in_range(int(whole.timestamp()) * 1_000_000_000 + nanos)


def _in_range(stamp_ns: int) -> int | None:
    return stamp_ns if abs(stamp_ns) <= _MAX_STAMP_NS else None
