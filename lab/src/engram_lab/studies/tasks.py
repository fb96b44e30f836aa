"""Tasks that need each other, run by one process or several; what is done already costs nothing."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import cv2

from engram.errors import ConfigError, WorkerError
from engram.monitor import Monitor
from engram.processes import end_with_parent


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """One step of an evaluation: it leaves what it makes on disk, where it is found again.

    Attributes:
        name: unique among the tasks of a run.
        work: picklable; what it returns is not looked at.
        needs: names of the tasks that must be done before it.
        word: for the progress bar.
        alone: whether it is timed, and has the machine for itself: such tasks are run in this
            process after all others, in their order.
    """

    name: str
    work: Callable[[], object]
    needs: tuple[str, ...] = ()
    word: str = ""
    alone: bool = False


def run_tasks(tasks: Sequence[Task], workers: int, monitor: Monitor) -> None:
    """Runs tasks in their order, side by side where they do not need each other.

    Args:
        tasks: each behind those that it needs.
        workers: processes; with one everything runs in this process.
        monitor: hears of each task that is done.

    Raises:
        ConfigError: there is no worker.
        WorkerError: a worker died.
        EngramError: whatever a task raised; the tasks that were done stay done.
    """
    if workers < 1:
        raise ConfigError(f"workers is {workers}, must be >= 1")
    beside, timed = ([one for one in tasks if one.alone is alone] for alone in (False, True))
    with _executor(workers) as executor:
        waiting, done = list(beside), set[str]()
        running: dict[Future[object], Task] = {}
        try:
            while waiting or running:
                # With one worker a task is done as soon as it is submitted: none overtakes.
                ready = next((one for one in waiting if done.issuperset(one.needs)), None)
                if ready is not None and len(running) < workers:
                    waiting.remove(ready)
                    running[executor.submit(ready.work)] = ready
                assert running, "a task needs one that does not come before it"
                if ready is None or len(running) == workers:
                    finished, _ = wait(running, return_when=FIRST_COMPLETED)
                    for future in finished:
                        task = running.pop(future)
                        future.result()
                        done.add(task.name)
                        monitor.advance(task.word)
        except BrokenProcessPool as error:
            raise WorkerError(
                f"a worker of {workers} died (out of memory?); give the same command again, "
                "perhaps with fewer --workers; what was done is kept"
            ) from error
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise
    for task in timed:
        task.work()
        monitor.advance(task.word)


class _Here(Executor):
    """Runs everything at once, in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@contextmanager
def _executor(workers: int) -> Iterator[Executor]:
    if workers == 1:
        yield _Here()
        return
    # Started afresh: a forked child would share the parent's threads half way through.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _begin_worker) as pool:
        yield pool


def _begin_worker() -> None:
    end_with_parent()
    cv2.setNumThreads(1)  # the tasks run side by side
