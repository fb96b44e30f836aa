"""Work on a Dask cluster. Dask is an extra, imported only if a scheduler is given."""

from __future__ import annotations

import asyncio
import queue
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from uuid import uuid4

from engram.errors import EngramError, WorkerError, extra
from engram.fleet.build.scratch import GroupResult, GroupTask, keeping, map_group_far_away
from engram.monitor import Monitor, write_whole
from engram.processes import LISTEN_S, MAX_RETRIES, WordsTogether

if TYPE_CHECKING:
    from distributed import Client, Future

_CONNECT_S = 30

Task = TypeVar("Task")
Result = TypeVar("Result")


class _GivenUpError(Exception):
    """Raised in a worker: the client no longer waits for this task."""


def map_groups_on_cluster(
    tasks: Sequence[GroupTask],
    scheduler: str,
    monitor: Monitor,
    mapped: Callable[[GroupResult], None],
) -> None:
    """Maps groups on the workers of a cluster, which read the drives themselves.

    Whole maps come back over the network: no shared disk is needed. For errors see
    `run_on_cluster`.

    Args:
        monitor: receives progress per frame; an exception of its `check` stops the workers too.
    """
    named = {f"group {task.number}": task for task in tasks}

    def done(name: str, made: tuple[GroupResult, bytes]) -> None:
        result, content = made
        _keep(named[name].path, content)
        mapped(result)

    run_on_cluster(_map_group, named, scheduler, monitor, done)


def _map_group(task: GroupTask, monitor: Monitor) -> tuple[GroupResult, bytes]:
    return map_group_far_away(task, monitor)


def run_on_cluster(
    work: Callable[[Task, Monitor], Result],
    tasks: Mapping[str, Task],
    scheduler: str,
    monitor: Monitor,
    done: Callable[[str, Result], None],
) -> None:
    """Runs each task on a worker of a cluster.

    Args:
        work: a function of a module, as for `run_in_processes`; it shares no disk with the caller.
        monitor: receives the words of all tasks; an exception of its `check` stops the workers too.
        done: called for each finished task with its name and result.
    """
    heard: queue.SimpleQueue[list[str] | Future] = queue.SimpleQueue()
    topic = f"engram-{uuid4().hex}"
    with _connected(scheduler) as client:  # closing it stops the workers
        client.subscribe_topic(topic, lambda event: heard.put(list(event[1])))
        names: dict[Future, str] = {}
        for name, task in tasks.items():
            # Not a cached pure function: each task is submitted once.
            future = client.submit(_on_worker, work, task, topic, pure=False, retries=MAX_RETRIES)
            names[future] = name
            future.add_done_callback(heard.put)
        while names:
            monitor.check()
            try:
                message = heard.get(timeout=LISTEN_S)
            except queue.Empty:
                continue
            words = message
            if not isinstance(message, list):
                name = names.pop(message)
                result, words = _outcome(message, name, scheduler)
                done(name, result)
            for word in words:
                monitor.advance(word)


def check_scheduler(scheduler: str) -> None:
    """Checks that a scheduler answers, before any work begins.

    Without a Dask client: one that fails to connect takes half a minute to close.
    """
    with _dask():
        from distributed import Security
        from distributed.comm import connect

    async def greet() -> None:
        ways = Security().get_connection_args("client")
        comm = await connect(scheduler, timeout=_CONNECT_S, **ways)
        await comm.close()

    try:
        # On its own thread: the caller's may run an event loop, as in a notebook.
        with ThreadPoolExecutor(1) as thread:
            thread.submit(lambda: asyncio.run(greet())).result()
    except OSError as error:
        raise _silent(scheduler, error) from error
    except Exception as error:  # each of Dask's transports has its own errors
        raise WorkerError(
            f"{scheduler!r} is not a valid scheduler address ({error}); an example is "
            "tcp://10.0.0.5:8786"
        ) from error


def _connected(scheduler: str) -> Client:
    """A client of its own, not registered as Dask's default."""
    with _dask():
        from distributed import Client
    check_scheduler(scheduler)
    try:
        return Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise _silent(scheduler, error) from error


def _dask() -> AbstractContextManager[None]:
    return extra("cluster", "work on a cluster needs Dask")


def _silent(scheduler: str, error: Exception) -> WorkerError:
    return WorkerError(
        f"the scheduler at {scheduler} does not answer ({error}); check that it runs and can be "
        "reached from here"
    )


def _on_worker(
    work: Callable[[Task, Monitor], Result], task: Task, topic: str
) -> tuple[Result, list[str]] | EngramError:
    """Runs in the worker. Errors of a drive are returned, not raised: a retry would repeat them."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def send(words: list[str]) -> None:
        worker.log_event(topic, words)
        known = worker.state.tasks.get(key)
        if known is None or known.state == "cancelled":
            raise _GivenUpError

    unsent = WordsTogether(send)
    try:
        result = work(task, unsent)
    except EngramError as error:
        return error
    return result, unsent.take()


def _outcome(future: Future, name: str, scheduler: str) -> tuple[Any, list[str]]:
    """The result of a task, fetched from the worker, and its last words."""
    try:
        outcome: tuple[Any, list[str]] | EngramError = future.result()
    except CancelledError as error:
        raise WorkerError(
            f"the scheduler at {scheduler} was lost, and {name} with it ({error}); what is "
            "finished is kept: run the same command again"
        ) from error
    except Exception as error:  # anything that Dask or a worker may raise
        raise WorkerError(
            f"{name} was not done on the cluster after {MAX_RETRIES + 1} tries: "
            f"{type(error).__name__}: {error}; what is finished is kept: run the "
            "same command again, with fewer workers if memory was short"
        ) from error
    if isinstance(outcome, EngramError):
        raise outcome
    return outcome


def _keep(path: Path, content: bytes) -> None:
    """Writes the group's map atomically, replacing one that another worker left unfinished."""
    with keeping(path.parent):
        for suffix in ("-wal", "-shm"):  # a log of another map would be applied to this one
            path.with_name(f"{path.name}{suffix}").unlink(missing_ok=True)
        with write_whole(path) as draft:
            draft.write_bytes(content)
