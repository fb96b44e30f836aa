"""One hand-in into the fleet map: checked in a process with limits, never twice, never lost.

The row says `complete` until the outcome is known. A worker that dies leaves it so, and the next
one merges again: what was committed is found by the content hash that its revision names.

Admission: what a robot handed in becomes a checked map, in a process with limits. The centre never
opens a file of a robot: it writes one of its own, from pages whose rows have exactly the types of
its tables, and verifies every record of it before anything else reads it.

A hand-in in a process of its own, so that none can end the worker. Whatever is raised in it ends
that hand-in, and so does its death: by a fault of memory, or by a system that is out of it. It is
not tried again until an operator asks for that.
"""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Literal

from engram.counts import counted
from engram.errors import (
    EngramError,
    MapCorruptError,
    MapLockedError,
    RefusedError,
    SequenceError,
    StorageFullError,
    WorkerError,
)
from engram.fleet.centre import handins, jobs
from engram.fleet.centre.copies import Publication
from engram.fleet.centre.fleet import move_ref
from engram.fleet.centre.problems import MissingPartsError, StoreError
from engram.fleet.centre.service import Centre, CentreSettings
from engram.fleet.centre.tables import HandIn, JobState
from engram.fleet.merge.merging import merge
from engram.fleet.merge.report import MergeReport
from engram.fleet.transfers import Manifest, PartHash, join
from engram.logs import logging_to_stderr
from engram.maps.map import Map
from engram.monitor import Monitor
from engram.places.words import problems_of
from engram.processes import end_with_parent
from engram.robot.settings import Settings

_NEW_USER, _NEW_NETWORK = 0x10000000, 0x40000000
_SHOWN_PROBLEMS = 5


class KilledError(WorkerError):
    """Something killed the process that checks a map."""


# What its children need; of SciPy, what merging imports only where it is used.
_PRELOADED = [
    __name__,
    "scipy.cluster.hierarchy",
    "scipy.sparse.csgraph",
    "scipy.sparse.linalg",
    "scipy.spatial.transform",
]


def _fork_server() -> ForkServerContext:
    """That of this process."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    return context


@dataclass(frozen=True, slots=True)
class Checker:
    """A process that waits for one map to check, and the pipe to it."""

    process: BaseProcess
    pipe: Connection


@contextmanager
def checker(method: Literal["fork", "forkserver"]) -> Iterator[Checker]:
    """Begins the process that checks one map; it ends with the block.

    Args:
        method: `fork` where this process is new and holds nothing of the centre yet: a child of a
            fork server does not reach that server, and would start another one, for a second.
    """
    context = multiprocessing.get_context(method) if method == "fork" else _fork_server()
    pipe, theirs = context.Pipe()
    process: BaseProcess = context.Process(target=_admit_confined, args=(theirs, pipe), daemon=True)
    process.start()
    theirs.close()
    try:
        yield Checker(process, pipe)
    finally:
        pipe.close()
        process.kill()
        process.join()


def admit(
    manifest: Manifest,
    parts: dict[PartHash, bytes],
    path: Path,
    memory_bytes: int,
    time_s: int,
    begun: Checker | None = None,
) -> None:
    """Writes the thin map of a hand-in and checks it.

    Args:
        manifest: what was handed in.
        parts: pages, and the blobs that merging reads.
        path: the file to write.
        memory_bytes: that the process may take, beyond what the parts take.
        time_s: processor time that it may take.
        begun: the process, if it was begun before; it checks no other map.

    Raises:
        MapCorruptError: the parts make no sound map.
        StorageFullError: there is no room for it now.
        KilledError: something else than the limits ended the process.
        WorkerError: the limits ended it.
    """
    size = sum(map(len, parts.values()))
    limits = (memory_bytes + 3 * size, time_s, 3 * size + 2**26)
    with checker("forkserver") if begun is None else nullcontext(begun) as asked:
        try:
            asked.pipe.send((manifest, parts, path, limits))
            outcome = asked.pipe.recv()
        except (EOFError, OSError):
            asked.process.join()
            code = asked.process.exitcode
            if code == -signal.SIGKILL:  # limits end it in other ways
                raise KilledError(
                    "the check of the map was killed, as by a system that is out of memory"
                ) from None
            raise WorkerError(
                f"the map took more than {memory_bytes} bytes or {time_s} s to check, exit code "
                f"{code}"
            ) from None
    if isinstance(outcome, EngramError):
        raise outcome


def _admit_confined(pipe: Connection, theirs: Connection) -> None:
    """Main function of the process; it ends if nothing comes through the pipe."""
    end_with_parent()
    theirs.close()
    try:
        manifest, parts, path, limits = pipe.recv()
    except EOFError:
        return
    confine(*limits)
    pipe.send(_checked(manifest, parts, path))


def _checked(manifest: Manifest, parts: dict[PartHash, bytes], path: Path) -> EngramError | None:
    """What `write_checked` raised."""
    try:
        write_checked(manifest, parts, path)
    except StorageFullError as error:
        return error
    except EngramError as error:
        return MapCorruptError(str(error))
    return None


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


_REPORT_S = 1.0


class JobMonitor(Monitor):
    """Reports the progress of a job, and stops it if it is cancelled.

    Args:
        report: notes the progress; returns whether the job is to be cancelled.
    """

    def __init__(self, report: Callable[[str], bool]) -> None:
        self._report = report
        self._reported_s = 0.0
        self._what, self._total, self._done = "", 0, 0

    @contextmanager
    def stage(self, what: str, total: int) -> Iterator[Monitor]:
        """See `Monitor`."""
        self._what, self._total, self._done = what.split(" /", 1)[0], total, 0
        yield self

    def advance(self, word: str = "") -> None:
        """See `Monitor`."""
        del word
        self._done += 1

    def check(self) -> None:
        """See `Monitor`."""
        now = time.monotonic()
        if now - self._reported_s < _REPORT_S:
            return
        self._reported_s = now
        if self._report(f"{self._what}: {self._done} of {self._total}"):
            raise KeyboardInterrupt


_log = logging.getLogger(__name__)
# A held-out drive that cannot be read is a SequenceError: robots hand in no drives.
_OF_THE_CENTRE = (StorageFullError, StoreError, MapLockedError, SequenceError)


class WaitsError(EngramError):
    """A hand-in waits for the centre."""


def merge_hand_in(centre: Centre, row: HandIn, begun: Checker | None = None) -> None:
    """Merges one complete hand-in.

    Args:
        begun: the process that checks it, if it was begun before.

    Raises:
        EngramError: what lies with the centre, and not with the hand-in, which waits: no space, a
            map that is being written to, a held-out drive that is gone.
    """
    thin = _thin_map(centre, row)
    if row.tries >= centre.settings.merge_tries:
        tries = counted(row.tries, "time")
        _clear(thin)
        _end(centre, row, f"its worker died {tries}; an operator may have it merged anyway")
        return
    handins.note_try(centre, row)
    begun_s = time.monotonic()
    try:
        with _scratch(thin):
            policy, manifest = centre.policy(row.map), handins.manifest_of(centre, row)
            parts, limits = handins.parts_to_merge(centre, row, manifest), centre.settings
            admit(manifest, parts, thin, limits.admission_bytes, limits.admission_s, begun)
            (report,) = merge(
                centre.map_path(row.map),
                [thin],
                policy.merge,
                JobMonitor(partial(jobs.heartbeat, centre, row)),
                settings=Settings(),
                require_better=[] if row.ungated else [Path(drive) for drive in policy.gate],
            )
            made = None if report.interrupted else centre.prepared(row.map)
    except MissingPartsError:  # the map changed since they were requested, by a revert
        jobs.set_state(centre, row, JobState.OPEN, tries=0)
    except RefusedError as error:
        _end(centre, row, centre.words_of(error), JobState.REFUSED)
    except KilledError as error:  # this try counts: the map may be what takes the memory
        raise WaitsError(f"{row.map}: hand-in {row.id[:8]} waits: {error}") from error
    except (*_OF_THE_CENTRE, OSError) as error:
        fact = centre.words_of(error)
        handins.put_off(centre, row, fact)
        raise WaitsError(f"{row.map}: hand-in {row.id[:8]} waits: {fact}") from error
    except KeyboardInterrupt:
        if not jobs.get(centre, HandIn, row.id).cancelled:
            raise
        _end(centre, row, "cancelled", JobState.CANCELLED)
    except EngramError as error:
        _end(centre, row, centre.words_of(error))
    except Exception as error:  # a stranger's map may bring about any: it ends this hand-in alone
        _log.exception("%s: hand-in %s", row.map, row.id[:8])
        _end(centre, row, f"an unexpected fault, {centre.fault_of(error)}")
    else:
        _settle(centre, row, report, made)
        took_s = time.monotonic() - begun_s
        _log.info("%s: hand-in %s took %.1f s of work", row.map, row.id[:8], took_s)


def _end(centre: Centre, row: HandIn, why: str, state: JobState = JobState.FAILED) -> None:
    jobs.set_state(centre, row, state, error=why)


def _settle(centre: Centre, row: HandIn, report: MergeReport, made: Publication | None) -> None:
    if report.interrupted:
        _end(centre, row, "cancelled", JobState.CANCELLED)
        return
    shown = {**report.to_dict(), "source": f"hand-in {row.id}"}
    revision = report.revision
    if revision is None:  # nothing new; or a worker died between the merge and this row
        revision = _revision_of(centre.map_path(row.map), row.content_hash)
    jobs.set_state(centre, row, JobState.MERGED, made=made, revision=revision, report=shown)
    policy = centre.policy(row.map)
    if policy.moves is not None and revision and not row.ungated:
        move_ref(centre, row.map, policy.moves, revision, "gate")


def _revision_of(path: Path, content_hash: str) -> int:
    """The revision that holds a map of this content: the one that merged it, or the newest."""
    with Map.open(path) as store:
        for entry in store.log():
            merged = entry.configuration.get("merge")
            if isinstance(merged, dict) and merged.get("source") == content_hash:
                return entry.number
        return store.revision


def _thin_map(centre: Centre, row: HandIn) -> Path:
    return centre.folder / "work" / f"{row.id}.engram"


@contextmanager
def _scratch(path: Path) -> Iterator[None]:
    """Removes what a file and its locks leave, before and after."""
    _clear(path)
    try:
        yield
    finally:
        _clear(path)


def _clear(path: Path) -> None:
    for left in path.parent.glob(f"{path.name}*"):
        left.unlink()


# Chosen first by a system that is out of memory, before the worker and the service.
_FIRST_TO_GO = "1000"


def merge_apart(centre: Centre, row: HandIn) -> None:
    """Merges one complete hand-in, as `merge_hand_in` does.

    Raises:
        WaitsError: it waits for the centre.
    """
    context = _fork_server()
    pipe, theirs = context.Pipe(duplex=False)
    given = (theirs, centre.folder, centre.addresses, centre.settings, row.id)
    process = context.Process(target=_merge, args=given)
    process.start()
    theirs.close()
    waits_for = ""
    try:
        waits_for = pipe.recv()
    except (EOFError, OSError):  # the hand-in has ended, or its process
        pass
    except BaseException:
        process.kill()
        raise
    finally:
        pipe.close()
        process.join()
    if waits_for:
        raise WaitsError(waits_for)
    row = jobs.get(centre, HandIn, row.id)
    if row.state == JobState.COMPLETE:
        _end_killer(centre, row, process)


def _end_killer(centre: Centre, row: HandIn, process: BaseProcess) -> None:
    """Ends a hand-in whose process died."""
    code = process.exitcode or 0
    how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
    fact = f"the process that merged it ended {how}; an operator may have it merged anyway"
    _log.error("%s: hand-in %s: %s", row.map, row.id[:8], fact)
    _clear(_thin_map(centre, row))
    _end(centre, row, fact)


def _merge(
    pipe: Connection,
    folder: Path,
    addresses: tuple[str | None, str | None],
    settings: CentreSettings,
    key: str,
) -> None:
    """Main function of the process: sends what the hand-in waits for, nothing if it has ended."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the worker ends it
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(_FIRST_TO_GO)
    with (
        logging_to_stderr(),
        checker("fork") as begun,
        Centre(folder, *addresses, settings) as centre,
    ):
        try:
            merge_hand_in(centre, jobs.get(centre, HandIn, key), begun)
        except (EngramError, OSError) as error:
            pipe.send(centre.words_of(error))
