"""Output to the screen: everything that verbs print passes through `printable`.

Names in maps, bags and answers of a centre are anybody's. They may hold sequences that recolour,
clear or retitle a terminal, or turn the direction of what follows. JSON escapes them by itself.
"""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from engram.untrusted import printable


class Screen(io.TextIOBase):
    """A text stream that shows control characters of names as �.

    It has no `buffer`, by which a program could write past it.

    Attributes:
        unfiltered: the stream behind it, for programs that draw with control characters and
            filter the names themselves.
    """

    def __init__(self, unfiltered: TextIO) -> None:
        self.unfiltered = unfiltered

    @property
    def encoding(self) -> str:  # type: ignore[override]  # of the stream behind
        """Of the stream behind it."""
        return self.unfiltered.encoding

    @property
    def errors(self) -> str | None:  # type: ignore[override]  # of the stream behind
        """Of the stream behind it."""
        return self.unfiltered.errors

    def write(self, text: str) -> int:
        """Writes a text as a terminal may show it."""
        with _writing():
            self.unfiltered.write(printable(text))
        return len(text)

    def flush(self) -> None:
        """See `io.TextIOBase`."""
        with _writing():
            self.unfiltered.flush()

    def writable(self) -> bool:
        """See `io.TextIOBase`."""
        return True

    def isatty(self) -> bool:
        """See `io.TextIOBase`."""
        return self.unfiltered.isatty()

    def fileno(self) -> int:
        """See `io.TextIOBase`."""
        return self.unfiltered.fileno()


class UnwritableError(Exception):
    """The output cannot be written: the disk is full, or the reader has closed it."""

    def __init__(self, cause: OSError) -> None:
        super().__init__(f"the output cannot be written: {cause.strerror}")
        self.reader_left = cause.errno == errno.EPIPE


@contextmanager
def _writing() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UnwritableError(error) from error


@contextmanager
def screen() -> Iterator[None]:
    """Lets everything that is printed pass through `printable` within the block.

    A stream that the caller closed takes everything and shows nothing.

    Raises:
        UnwritableError: something cannot be written.
    """
    plain = sys.stdout, sys.stderr
    with Path(os.devnull).open("w") as nowhere:
        shown, complained = (Screen(stream or nowhere) for stream in plain)
        sys.stdout, sys.stderr = shown, complained
        try:
            yield
        finally:
            sys.stdout, sys.stderr = plain
            shown.flush()


def forget(stream: TextIO | None) -> None:
    """Drops what a stream still holds, so that Python does not complain about it at its end."""
    if stream is not None:
        with Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), stream.fileno())


def drawing(stream: TextIO) -> TextIO:
    """The stream for a program that draws with control characters, such as bars and tables."""
    return stream.unfiltered if isinstance(stream, Screen) else stream
