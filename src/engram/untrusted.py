"""Files and texts of unknown origin: regular files, bounded sizes, no control characters."""

from __future__ import annotations

import os
import re
import stat
import unicodedata
from pathlib import Path

from engram.errors import InputError, SequenceError

# Text files beside images; the longest real one (an hour of ROS images at 100 Hz) has 20 MB.
_MAX_TEXT_BYTES = 100_000_000
_PLAIN = re.compile(r"[\n\x20-\x7e]*")


def open_regular(path: Path, error: type[InputError] = SequenceError) -> int:
    """A descriptor of a regular file, opened for reading; never waits at a pipe."""
    try:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        raise error(f"{path}: the file is missing") from None
    except OSError as fault:
        raise error(f"{path}: cannot be read: {fault.strerror}") from fault
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise error(f"{path}: cannot be read: it is a folder, pipe or device, not a file")
    return file


def read_bytes(path: Path, most: int, error: type[InputError] = SequenceError) -> bytes:
    """The content of a regular file of at most `most` bytes."""
    with os.fdopen(open_regular(path, error), "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise error(f"{path}: {size} bytes, at most {most} are read")
        try:
            return file.read(most + 1)
        except OSError as fault:
            raise error(f"{path}: cannot be read: {fault.strerror}") from fault


def read_text(
    path: Path, error: type[InputError] = SequenceError, most: int = _MAX_TEXT_BYTES
) -> str:
    """The text of a regular file."""
    try:
        return read_bytes(path, most, error).decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        raise error(f"{path}: not UTF-8 text at byte {fault.start}") from fault


def printable(text: str) -> str:
    """The text as a terminal may show it: line feeds stay, other control characters become �.

    Names in bags and files may hold sequences that recolour, clear or retitle a terminal.
    """
    if _PLAIN.fullmatch(text):
        return text
    return "".join(
        character
        if character == "\n" or unicodedata.category(character) not in {"Cc", "Cf", "Cs", "Co"}
        else "�"
        for character in text
    )
