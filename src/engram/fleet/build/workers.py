"""Groups mapped in processes of this machine: who dies is replaced, none outlives its parent."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

import cv2

from engram.errors import EngramError, WorkerError
from engram.fleet.build.group_mapping import GroupResult, GroupTask, map_group
from engram.processes import end_with_parent

# A drive that kills its worker this often will do so again.
MAX_RETRIES = 3
# Words on the way are put together so that the pipe is not the bottleneck.
WORDS_AT_ONCE = 10
# How long Ctrl-C may wait.
LISTEN_S = 0.5


@dataclass(slots=True)
class _Running:
    task: GroupTask
    process: BaseProcess
    pipe: Connection
    result: GroupResult | None = None
    error: Exception | None = None


def map_groups(
    tasks: Sequence[GroupTask],
    place: Callable[[int], Path],
    workers: int,
    advance: Callable[[str], None],
    check: Callable[[], None],
    mapped: Callable[[GroupResult], None],
) -> None:
    """Maps groups, several at a time.

    Args:
        tasks: the groups.
        place: the map of a group, by its number.
        workers: processes at a time.
        advance: called once per frame with a word on how it went.
        check: called now and then; what it raises ends the work.
        mapped: told of each group that is done.

    Raises:
        WorkerError: a worker died again and again over the same group.
        EngramError: a group cannot be mapped.
    """
    waiting = list(tasks)
    retries = dict.fromkeys((task.number for task in tasks), 0)
    with _team() as running:
        while waiting or running:
            while waiting and len(running) < workers:
                task = waiting.pop(0)
                running.append(_start(task, place(task.number)))
            _listen(running, advance)
            check()
            for one in [one for one in running if not one.process.is_alive()]:
                _hear(one, advance)
                running.remove(one)
                one.pipe.close()
                if one.error is not None:
                    raise one.error
                if one.result is not None:
                    one.result.retries = retries[one.task.number]
                    mapped(one.result)
                    continue
                retries[one.task.number] += 1
                if retries[one.task.number] > MAX_RETRIES:
                    raise WorkerError(
                        f"the worker of group {one.task.number} died {MAX_RETRIES + 1} times, last "
                        f"with exit code {one.process.exitcode}; what the groups have is kept: "
                        "give the same command again, with fewer workers if memory was short"
                    )
                waiting.insert(0, one.task)


@contextmanager
def _team() -> Iterator[list[_Running]]:
    """The workers; whoever still runs at the end is ended. Their maps stay sound."""
    running: list[_Running] = []
    try:
        yield running
    finally:
        for one in running:
            one.process.terminate()
        for one in running:
            one.process.join()


def _start(task: GroupTask, path: Path) -> _Running:
    # Spawned, not forked: a fork would inherit the locks of threads that it does not.
    context = multiprocessing.get_context("spawn")
    pipe, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(task, path, theirs), daemon=True)
    process.start()
    theirs.close()
    return _Running(task, process, pipe)


def _work(task: GroupTask, path: Path, pipe: Connection) -> None:
    """In the worker: Ctrl-C is for the parent, which ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    cv2.setNumThreads(1)  # the groups run side by side
    words: list[str] = []

    def advance(word: str) -> None:
        words.append(word)
        if len(words) >= WORDS_AT_ONCE:
            pipe.send(list(words))
            words.clear()

    try:
        outcome: GroupResult | EngramError = map_group(task, path, advance)
    except EngramError as error:
        outcome = error
    pipe.send(words)
    pipe.send(outcome)
    pipe.close()


def _listen(running: Sequence[_Running], advance: Callable[[str], None]) -> None:
    """Until something happens, but no longer than Ctrl-C should take."""
    ready = wait(
        [one.pipe for one in running] + [one.process.sentinel for one in running], LISTEN_S
    )
    for one in running:
        if one.pipe in ready:
            _hear(one, advance)


def _hear(one: _Running, advance: Callable[[str], None]) -> None:
    """All that a worker has said."""
    try:
        while one.pipe.poll():
            said = one.pipe.recv()
            if isinstance(said, GroupResult):
                one.result = said
            elif isinstance(said, EngramError):
                one.error = said
            else:
                for word in said:
                    advance(word)
    except (EOFError, OSError):  # it is over: by itself, or killed in the midst of a word
        one.process.join()
