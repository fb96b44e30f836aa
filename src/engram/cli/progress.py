"""The progress bar of long work: rate, time left, and a word on how it goes. On stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from engram.cli.screen import drawing
from engram.monitor import Advancing, Monitor
from engram.untrusted import printable


class Bars(Monitor):
    """Shows a bar for each part of the work."""

    @contextmanager
    def stage(self, what: str, total: int) -> Iterator[Monitor]:
        """One bar."""
        with progress(what, total) as advance:
            yield Advancing(advance)


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[str], None]]:
    """Shows a bar; yields a function to call once per item with a word on how it goes."""
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
    console = Console(file=drawing(sys.stderr))
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(printable(what), total=total, word="")

        def advance(word: str) -> None:
            bar.update(task, advance=1, word=printable(word))

        yield advance
