"""The one way to the screen: whatever verbs print, and how long work goes.

Names in maps, bags and answers of a centre are anybody's. They may hold sequences that recolour,
clear or retitle a terminal, or turn the direction of what follows. JSON escapes them by itself.
"""

from __future__ import annotations

import errno
import io
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from engram.monitor import Advancing, Monitor
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


# Seconds between two lines in a log: work that is done sooner leaves none.
EVERY_S = 10.0
# The time left follows from the pace of so many last seconds, once so many items and seconds are
# known of it.
_PACE_S, _LEAST_ITEMS, _LEAST_S = 30.0, 3, 2.0


class Pace:
    """How fast items have been finished lately.

    The first one, and those within a second of it, only start the clock: the first waits for what
    is loaded or built once, and the others may have been finished by an earlier run.
    """

    def __init__(self) -> None:
        self._done = 0
        # Time, s, and number of finished items, at most one entry a second.
        self._marks: deque[tuple[float, int]] = deque()
        self._first_s = 0.0

    def advance(self, now_s: float) -> None:
        """Counts an item finished at a time, s."""
        self._done += 1
        if not self._marks:
            self._first_s = now_s
        if now_s - self._first_s < 1.0:
            self._marks.clear()
        if not self._marks or now_s - self._marks[-1][0] >= 1.0:
            self._marks.append((now_s, self._done))
        while len(self._marks) > 2 and now_s - self._marks[1][0] >= _PACE_S:
            self._marks.popleft()

    def left_s(self, remaining: int, now_s: float) -> float | None:
        """Seconds for the remaining items at this pace; None while too little is known."""
        if not self._marks:
            return None
        then_s, before = self._marks[0]
        items, took_s = self._done - before, now_s - then_s
        if items < _LEAST_ITEMS or took_s < _LEAST_S:
            return None
        return took_s * remaining / items


class Bars(Monitor):
    """Shows the progress of each part of the work, with rate, time left and a word on how it goes.

    Args:
        clock: seconds that never go back.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._written_s = clock()

    @contextmanager
    def stage(self, what: str, total: int) -> Iterator[Monitor]:
        """One bar, or the lines of one part."""
        if sys.stderr.isatty():
            with _bar(what, total) as advance:
                yield Advancing(advance)
        else:
            yield Advancing(self._lines(what, total))

    def _lines(self, what: str, total: int) -> Callable[[str], None]:
        """Announces a part of the work; what is called once per item."""
        pace, done = Pace(), 0

        def write(words: str) -> None:
            now_s = self._clock()
            if now_s - self._written_s < EVERY_S:
                return
            self._written_s = now_s
            left_s = pace.left_s(total - done, now_s)
            left = "" if left_s is None else f", {left_s:.0f} s left"
            print(f"{what}: {done} of {total}{left}{words}", file=sys.stderr, flush=True)

        def advance(word: str) -> None:
            nonlocal done
            done += 1
            pace.advance(self._clock())
            write(f", {word}" if word else "")

        write("")
        return advance


@contextmanager
def _bar(what: str, total: int) -> Iterator[Callable[[str], None]]:
    """A bar; yields what is called once per item."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            speed = task.finished_speed or task.speed
            return Text("" if speed is None else f"{speed:.0f}/s")

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[word]}", markup=False),
    )
    with Progress(*columns, console=Console(file=drawing(sys.stderr))) as bar:
        task = bar.add_task(printable(what), total=total, word="")

        def advance(word: str) -> None:
            bar.update(task, advance=1, word=printable(word))

        yield advance
