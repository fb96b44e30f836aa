"""A fork server: each case in a child of its own, which ends at its limits."""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import sqlite3
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeAlias

from engram.sqlite import SqliteFile

# Wall time after which a child that does not even compute is ended.
_STUCK_S = 300.0
# Functions of SQL that Engram's own statements call.
_OWN_FUNCTIONS = frozenset(
    {"count", "sum", "max", "min", "length", "substr", "quote", "like", "coalesce", "row_number"}
)
_AUTHORISE_FUNCTION = 31
# What no reader of a file does; see "Audit events table" of Python.
_DEEDS = {
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.fork",
    "subprocess.Popen",
    "pickle.find_class",
    "sqlite3.enable_load_extension",
    "sqlite3.load_extension",
    "socket.connect",
    "socket.bind",
    "ctypes.dlopen",
}


@dataclass(frozen=True, slots=True)
class Limits:
    """What reading one changed thing may take.

    Attributes:
        seconds: processor time.
        bytes: memory beyond the parent's.
    """

    seconds: float = 10.0
    bytes: int = 2**30


# A calibration or a file of settings has a few kilobytes.
OF_TEXTS = Limits(2.0, 200_000_000)
# Names the change that is tried.
Tell: TypeAlias = Callable[[str], None]


class Outcome(StrEnum):
    """Result of a case."""

    REFUSED = "refused"
    READ = "read"
    CRASH = "crash"
    HANG = "hang"
    MEMORY = "memory"
    TRACEBACK = "traceback"
    EXECUTED = "executed"
    UNSEEN = "unseen"


# What a child does: outcome and detail.
Work: TypeAlias = Callable[[Tell], tuple[Outcome, str]]


@dataclass(frozen=True, slots=True)
class Trial:
    """One case that was tried.

    Attributes:
        outcome: of the gravest kind met.
        what: the change.
        detail: traceback, signal, or what was unseen.
        seconds: processor time.
        megabytes: memory beyond the parent's.
    """

    outcome: Outcome
    what: str = ""
    detail: str = ""
    seconds: float = 0.0
    megabytes: float = 0.0


def tried(work: Work, folder: Path, limits: Limits | None = None) -> Trial:
    """Runs `work` in a child.

    Args:
        work: names the change to its argument, and returns outcome and detail.
        folder: the only one in which the child may write.
        limits: what it may take; None for the usual ones.
    """
    limits = limits or Limits()
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        _in_child(work, folder, write, limits)
    os.close(write)
    told, stuck = _heard(read, child)
    _, status, used = os.wait4(child, 0)
    spent_s = used.ru_utime + used.ru_stime
    return _judged(told, status, stuck, spent_s, limits)


def _heard(read: int, child: int) -> tuple[list[dict[str, Any]], bool]:
    """What the child reported, a line each, and whether it had to be ended."""
    told, end_s = b"", time.monotonic() + _STUCK_S
    with os.fdopen(read, "rb", buffering=0) as pipe:
        while True:
            ready, _, _ = select.select([pipe], [], [], max(0.0, end_s - time.monotonic()))
            if not ready:
                os.kill(child, signal.SIGKILL)
                return _lines(told), True
            some = pipe.read(65_536)
            if not some:
                return _lines(told), False
            told += some


def _lines(told: bytes) -> list[dict[str, Any]]:
    return [json.loads(line) for line in told.splitlines()]


def _judged(
    told: list[dict[str, Any]], status: int, stuck: bool, spent_s: float, limits: Limits
) -> Trial:
    facts: dict[str, Any] = {}
    for one in told:
        facts |= one
    what, grown = facts.get("what", ""), facts.get("megabytes", 0.0)
    outcome = Outcome(facts.get("outcome", Outcome.CRASH))
    detail = facts.get("detail", "")
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        hung = stuck or number == signal.SIGXCPU or spent_s > limits.seconds
        outcome = Outcome.HANG if hung else Outcome.CRASH
        detail = signal.Signals(number).name
    elif grown * 1e6 > limits.bytes:
        outcome = Outcome.MEMORY
    elif spent_s > limits.seconds and outcome in {Outcome.READ, Outcome.REFUSED}:
        outcome = Outcome.HANG
    return Trial(outcome, what, detail, round(spent_s, 3), round(grown, 1))


def _in_child(work: Work, folder: Path, write: int, limits: Limits) -> None:
    """Never returns."""

    def tell(**facts: object) -> None:
        os.write(write, (json.dumps(facts) + "\n").encode())

    deeds: list[str] = []
    started_kb = _peak_kb()
    try:
        _watch(deeds, folder)
        _limit(limits)
        outcome, detail = work(lambda what: tell(what=what))
    except MemoryError:
        outcome, detail = Outcome.MEMORY, traceback.format_exc(limit=-4)
    except BaseException:
        outcome, detail = Outcome.TRACEBACK, traceback.format_exc(limit=-6)
    if deeds:
        outcome, detail = Outcome.EXECUTED, ", ".join(deeds[:5])
    grown = (_peak_kb() - started_kb) / 1e3
    tell(outcome=outcome, detail=detail[-2000:], megabytes=grown)
    os._exit(0)


def _peak_kb() -> int:
    """Largest resident memory so far; children begin with their parent's."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _limit(limits: Limits) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + limits.bytes + 2**28
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    whole = int(limits.seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (whole, whole + 2))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _watch(deeds: list[str], folder: Path) -> None:
    """Notes what a file made Engram do."""
    inside = str(folder.resolve())

    def audit(event: str, arguments: tuple[Any, ...]) -> None:
        if event in _DEEDS:
            deeds.append(f"{event} {arguments!r:.100}")
        elif event == "open" and _writes(arguments, inside):
            deeds.append(f"writes {arguments[0]}")

    def authorise(action: int, _: str | None, name: str | None, *__: object) -> int:
        if action == _AUTHORISE_FUNCTION and name and name.lower() not in _OWN_FUNCTIONS:
            deeds.append(f"SQL function {name}")
        return sqlite3.SQLITE_OK

    plain = SqliteFile.connect

    def connect(self: SqliteFile, options: str) -> sqlite3.Connection:
        connection = plain(self, options)
        connection.set_authorizer(authorise)
        return connection

    SqliteFile.connect = connect  # type: ignore[method-assign]
    sys.addaudithook(audit)


def _writes(arguments: tuple[Any, ...], inside: str) -> bool:
    """Whether a file elsewhere is opened for writing."""
    path, mode = arguments[:2]
    if not isinstance(path, str) or not isinstance(mode, str):
        return False
    return any(one in mode for one in "wax+") and not str(Path(path).resolve()).startswith(inside)
