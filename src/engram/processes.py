"""Work in processes on this machine: dead workers are replaced, none outlives its parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from engram.errors import EngramError, WorkerError
from engram.monitor import Monitor

Task = TypeVar("Task")
Result = TypeVar("Result")

# Retries of a task that kills its worker.
MAX_RETRIES = 3
# Longest delay of Ctrl-C.
LISTEN_S = 0.5
# Words per message, so that the pipe is not the bottleneck.
_WORDS_AT_ONCE = 10


def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class WordsTogether(Monitor):
    """A worker's monitor, which sends the words of `advance` in batches."""

    def __init__(self, send: Callable[[list[str]], object]) -> None:
        self._send = send
        self._words: list[str] = []

    def advance(self, word: str = "") -> None:
        """See `Monitor`."""
        self._words.append(word)
        if len(self._words) >= _WORDS_AT_ONCE:
            self._send(self.take())

    def take(self) -> list[str]:
        """Returns and clears the words not sent yet."""
        words, self._words = self._words, []
        return words


def run_in_processes(
    work: Callable[[Task, Monitor], Result],
    tasks: Mapping[str, Task],
    workers: int,
    monitor: Monitor,
    done: Callable[[str, Result, int], None],
) -> None:
    """Runs each task in its own process, several at a time.

    Args:
        work: a function of a module; its monitor forwards to `monitor`. Its process may end at any
            time; run again, it must continue from there.
        monitor: receives the words of all tasks; its `check` may end the work.
        done: called for each finished task with its name, result and number of dead workers.
    """
    waiting = list(tasks)
    retries = dict.fromkeys(tasks, 0)
    with _team() as running:
        while waiting or running:
            while waiting and len(running) < workers:
                name = waiting.pop(0)
                running.append(_start(work, name, tasks[name]))
            _listen(running, monitor)
            monitor.check()
            for worker in [worker for worker in running if not worker.process.is_alive()]:
                _hear(worker, monitor)
                running.remove(worker)
                worker.pipe.close()
                if worker.outcome is None:
                    _count_death(worker, retries)
                    waiting.insert(0, worker.name)
                elif isinstance(worker.outcome, Exception):
                    raise worker.outcome
                else:
                    done(worker.name, worker.outcome[0], retries[worker.name])


@dataclass(slots=True)
class _Running:
    name: str
    process: BaseProcess
    pipe: Connection
    outcome: tuple[Any] | Exception | None = None


def _count_death(worker: _Running, retries: dict[str, int]) -> None:
    retries[worker.name] += 1
    if retries[worker.name] > MAX_RETRIES:
        raise WorkerError(
            f"the worker of {worker.name} died {MAX_RETRIES + 1} times, last with exit code "
            f"{worker.process.exitcode}; progress is kept: give the same command again, with fewer "
            "workers if memory was short"
        )


@contextmanager
def _team() -> Iterator[list[_Running]]:
    """The workers; ends those that still run at the end of the block."""
    running: list[_Running] = []
    try:
        yield running
    finally:
        for worker in running:
            worker.process.terminate()
        for worker in running:
            worker.process.join()


# Read once, when a process loads NumPy or SciPy.
_BLAS_THREADS = "OPENBLAS_NUM_THREADS"


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Processes started in the block use one thread of BLAS, unless the environment says how many.

    Our matrices are too small for more, and idle threads of BLAS spin on the cores that other
    workers need.
    """
    if _BLAS_THREADS in os.environ:
        yield
        return
    os.environ[_BLAS_THREADS] = "1"
    try:
        yield
    finally:
        del os.environ[_BLAS_THREADS]


def _start(work: Callable[[Task, Monitor], Result], name: str, task: Task) -> _Running:
    # Spawned: a forked child would inherit the locks of the parent's threads.
    context = multiprocessing.get_context("spawn")
    pipe, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(work, task, theirs), daemon=True)
    with one_blas_thread():
        process.start()
    theirs.close()
    return _Running(name, process, pipe)


def _work(work: Callable[[Task, Monitor], Result], task: Task, pipe: Connection) -> None:
    """Main function of a worker. It ignores Ctrl-C: the parent ends its workers."""
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    cv2.setNumThreads(1)  # the tasks run side by side
    words = WordsTogether(pipe.send)
    try:
        outcome: tuple[Result] | EngramError = (work(task, words),)
    except EngramError as error:
        outcome = error
    pipe.send(words.take())
    pipe.send(outcome)
    pipe.close()


def _listen(running: Sequence[_Running], monitor: Monitor) -> None:
    ready = wait(
        [worker.pipe for worker in running] + [worker.process.sentinel for worker in running],
        LISTEN_S,
    )
    for worker in running:
        if worker.pipe in ready:
            _hear(worker, monitor)


def _hear(worker: _Running, monitor: Monitor) -> None:
    try:
        while worker.pipe.poll():
            message = worker.pipe.recv()
            if isinstance(message, list):
                for word in message:
                    monitor.advance(word)
            else:
                worker.outcome = message
    except (EOFError, OSError):  # the worker has ended or was killed within a message
        worker.process.join()


def end_with_parent() -> None:
    """Ends this process as soon as its parent has ended, even by a kill.

    Otherwise a worker would keep locks and write files during the next run. Call it in the worker,
    whose work may end at any time.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch(sentinel: int) -> None:
        wait([sentinel])
        os._exit(1)

    threading.Thread(target=watch, args=(parent.sentinel,), daemon=True).start()
