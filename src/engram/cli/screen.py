"""The one way to the screen: whatever verbs print passes through `printable`.

Names in maps, bags and answers of a centre are anybody's. They may hold sequences that recolour,
clear or retitle a terminal, or turn the direction of what follows. JSON escapes them by itself.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager
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
        self.unfiltered.write(printable(text))
        return len(text)

    def flush(self) -> None:
        """See `io.TextIOBase`."""
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


@contextmanager
def screen() -> Iterator[None]:
    """Lets everything that is printed pass through `printable` within the block."""
    plain = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(Screen, plain)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = plain


def drawing(stream: TextIO) -> TextIO:
    """The stream for a program that draws with control characters, such as bars and tables."""
    return stream.unfiltered if isinstance(stream, Screen) else stream
