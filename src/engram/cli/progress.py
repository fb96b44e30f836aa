"""How long work goes, on stderr: a bar on a terminal, else a plain line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from engram.cli.screen import drawing
from engram.monitor import Advancing, Monitor
from engram.untrusted import printable

# Seconds between two lines in a log: work that is done sooner leaves none.
EVERY_S = 10.0


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
        begun_s, done = self._clock(), 0

        def write(words: str) -> None:
            now_s = self._clock()
            if now_s - self._written_s < EVERY_S:
                return
            self._written_s = now_s
            left = f", {(now_s - begun_s) * (total - done) / done:.0f} s left" if done else ""
            print(f"{what}: {done} of {total}{left}{words}", file=sys.stderr, flush=True)

        def advance(word: str) -> None:
            nonlocal done
            done += 1
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
