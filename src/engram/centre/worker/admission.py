"""Admission: what a robot handed in becomes a checked map, in a process with limits.

The centre never opens a file of a robot: it writes one of its own, from pages whose rows have
exactly the types of its tables, and verifies every record of it before anything else reads it.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import resource
import signal
from multiprocessing.connection import Connection
from pathlib import Path

from engram.errors import EngramError, MapCorruptError, StorageFullError, WorkerError
from engram.places.words import problems_of
from engram.processes import end_with_parent
from engram.transfers import Manifest, PartHash, join

_NEW_USER, _NEW_NETWORK = 0x10000000, 0x40000000
_SHOWN_PROBLEMS = 5


class KilledError(WorkerError):
    """Something killed the process that checks a map."""


def admit(
    manifest: Manifest, parts: dict[PartHash, bytes], path: Path, memory_bytes: int, time_s: int
) -> None:
    """Writes the thin map of a hand-in and checks it.

    Args:
        manifest: what was handed in.
        parts: pages, and the blobs that merging reads.
        path: the file to write.
        memory_bytes: that the process may take, beyond what the parts take.
        time_s: processor time that it may take.

    Raises:
        MapCorruptError: the parts make no sound map.
        StorageFullError: there is no room for it now.
        KilledError: something else than the limits ended the process.
        WorkerError: the limits ended it.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    pipe, theirs = context.Pipe()
    size = sum(map(len, parts.values()))
    limits = (memory_bytes + 3 * size, time_s, 3 * size + 2**26)
    process = context.Process(target=_admit, args=(theirs, limits), daemon=True)
    process.start()
    theirs.close()
    try:
        pipe.send((manifest, parts, path))
        outcome = pipe.recv()
    except (EOFError, OSError):
        process.join()
        if process.exitcode == -signal.SIGKILL:  # limits end it in other ways
            raise KilledError(
                "the check of the map was killed, as by a system that is out of memory"
            ) from None
        raise WorkerError(
            f"the map took more than {memory_bytes} bytes or {time_s} s to check, exit code "
            f"{process.exitcode}"
        ) from None
    finally:
        pipe.close()
    process.join()
    if isinstance(outcome, EngramError):
        raise outcome


def _admit(pipe: Connection, limits: tuple[int, int, int]) -> None:
    """Main function of the process."""
    end_with_parent()
    manifest, parts, path = pipe.recv()
    confine(*limits)
    outcome: EngramError | None = None
    try:
        write_checked(manifest, parts, path)
    except StorageFullError as error:
        outcome = error
    except EngramError as error:
        outcome = MapCorruptError(str(error))
    pipe.send(outcome)


def write_checked(manifest: Manifest, parts: dict[PartHash, bytes], path: Path) -> None:
    """Main function of the process: joins the parts, and verifies every record.

    Raises:
        MapCorruptError: the parts make no sound map.
    """
    join(manifest, parts.get, path, thin=True)
    problems = problems_of(path, thin=True)
    if problems:
        shown = "; ".join(map(str, problems[:_SHOWN_PROBLEMS]))
        raise MapCorruptError(f"{len(problems)} faults: {shown}")


def confine(memory_bytes: int, time_s: int, file_bytes: int) -> None:
    """Limits this process permanently, and cuts off its network where the system allows."""
    _lower(resource.RLIMIT_AS, memory_bytes, memory_bytes)
    _lower(resource.RLIMIT_CPU, time_s, time_s + 5)
    _lower(resource.RLIMIT_FSIZE, file_bytes, file_bytes)
    _lower(resource.RLIMIT_CORE, 0, 0)
    ctypes.CDLL(None).unshare(_NEW_USER | _NEW_NETWORK)
    os.nice(5)


def _lower(kind: int, soft: int, hard: int) -> None:
    """Sets a limit; one that the system has set lower stays, since it cannot be raised."""
    most = resource.getrlimit(kind)[1]
    if most != resource.RLIM_INFINITY:
        soft, hard = min(soft, most), min(hard, most)
    resource.setrlimit(kind, (soft, hard))
