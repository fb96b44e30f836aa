"""Reads a changed thing in every way, each in a child of its own, which ends at its limits."""

from __future__ import annotations

import json
import os
import re
import resource
import select
import shutil
import signal
import sqlite3
import sys
import time
import traceback
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

from engram.calibration.formats import read_calibration
from engram.calibration.toml import CalibrationFile, calibration_toml
from engram.cli.settings import read_settings
from engram.config import load_toml
from engram.errors import EngramError
from engram.fleet.centre.merge_job import write_checked
from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.merging import merge
from engram.fleet.transfers import Manifest, decode_manifest, split
from engram.graph.clock import check_zone, hour_of_day, zone_note
from engram.graph.model import Clock
from engram.maps.map import Map
from engram.maps.map_files import check_file, copy_map
from engram.places.vocabulary import decode_vocabulary
from engram.sequences.framelog.file import FLIGHT_SUFFIX
from engram.sequences.framelog.log_writer import read_decisions, read_images, read_report
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.sequence import SequenceInfo
from engram.sqlite import SqliteFile
from engram_lab.mutations.case import Case, Subject

# Wall time after which a child that does not even compute is ended.
_STUCK_S = 300.0
# Functions of SQL that Engram's own statements call.
_OWN_FUNCTIONS = frozenset(
    {
        "count",
        "sum",
        "max",
        "min",
        "length",
        "substr",
        "instr",
        "quote",
        "like",
        "coalesce",
        "row_number",
    }
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


Held = dict[str, list[tuple[Any, ...]]]

# What a map of other records cannot take: without a relocaliser, as random landmarks match nothing.
_MERGING = MergeOptions(relocaliser="none")
_FOUND = re.compile(r"make a map of content ([0-9a-f]{32})")
# Follow from other rows, or tell nothing of the map.
_DERIVED = frozenset({"words"})
# So many first and last nodes are read one by one, too, as a robot does.
_SINGLY = 100


def read(case: Case, folder: Path, *, merges: bool) -> bool:
    """Reads a changed thing in every way.

    Returns:
        Whether it passed the check of its kind.
    """
    if case.subject is Subject.HANDIN:
        return _hand_in(case, folder, merges)
    assert case.path is not None
    if case.subject is Subject.TEXT:
        return _read_text(case.path)
    if case.subject is Subject.MAP:
        return _read_map(case.path, folder, merges)
    return _read_drive(case.path)


def held(path: Path) -> Held:
    """The rows of a file as SQLite shows them, by table; {} if it cannot be read.

    A copy is read: to open a file folds its log into it.
    """
    found: Held = {}
    try:
        with (
            TemporaryDirectory(dir=path.parent) as folder,
            closing(sqlite3.connect(_copy(path, folder))) as (connection),
        ):
            connection.text_factory = bytes
            names = connection.execute(
                "SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY name"
            )
            for (name,) in names.fetchall():
                table = name.decode()
                if table not in _DERIVED:
                    rows = connection.execute(f"SELECT * FROM {table} ORDER BY 1")
                    found[table] = rows.fetchall()
    except (sqlite3.Error, UnicodeDecodeError):
        return {}
    return found


def _copy(path: Path, folder: str) -> Path:
    copy = Path(folder) / path.name
    for suffix in ("", "-wal"):
        if Path(f"{path}{suffix}").exists():
            shutil.copyfile(f"{path}{suffix}", f"{copy}{suffix}")
    return copy


def _read_map(path: Path, folder: Path, merges: bool) -> bool:
    try:
        report = check_file(path)
        sound = report.sound and not report.notes
    except EngramError:
        sound = False
    with suppress(EngramError), Map.open(path) as store:
        _each(_READERS, store)
    _each((lambda _: split(path), lambda _: copy_map(path, folder / "copy.engram")), None)
    with suppress(EngramError):
        if merges:
            merge(folder / "fleet.engram", [path], _MERGING)
    with suppress(EngramError), Map.open(path, writes=True) as store:
        store.tag("seen", author="lab")
    return sound


def _each(readers: Iterable[Callable[[Any], object]], store: Any) -> None:
    """Each reader by itself: what one refuses another may read."""
    for one in readers:
        with suppress(EngramError):
            one(store)


def _frames(store: Map) -> None:
    nodes = store.load().nodes
    with suppress(EngramError):
        list(store.frames.stored(nodes))
    for node in [*nodes[:_SINGLY], *nodes[-_SINGLY:]]:
        with suppress(EngramError):
            store.frames.frame(node.id)
        with suppress(EngramError):
            store.frames.thumbnail(node.id)
        with suppress(EngramError):
            list(store.frames.stored([node]))


def _vocabulary(store: Map) -> None:
    if store.vocabulary is not None:
        decode_vocabulary(store.vocabulary)


_READERS: tuple[Callable[[Map], object], ...] = (
    lambda store: store.log(),
    lambda store: store.info(),
    lambda store: store.tags(),
    lambda store: store.content_hash(),
    lambda store: store.record_hashes(),
    lambda store: (store.graph, store.path_memory, store.attempts),
    lambda store: (store.frame, store.goals),
    lambda store: store.anchors,
    lambda store: store.removals,
    lambda store: store.statistics(),
    lambda store: store.words(bytes(16), [one.id for one in store.load().nodes]),
    lambda store: store.omissions,
    lambda store: store.interrupted(),
    lambda store: store.lookups.blob_sizes([one.id for one in store.load().nodes]),
    lambda store: store.diff(0, "head"),
    lambda store: [store.origin(str(one.id)) for one in store.load().nodes[:2]],
    lambda store: [hour_of_day(one, one.start_ns) for one in store.sessions.values()],
    _vocabulary,
    _frames,
)


def _read_drive(path: Path) -> bool:
    try:
        log = FrameLog(path)
        for at, one in enumerate(log):
            assert one.frame.stamp_ns is not None
            log.ranked(at)
    except EngramError:
        return False
    if path.suffix == FLIGHT_SUFFIX:
        with suppress(EngramError):
            read_report(path)
            for number in read_decisions(path):
                read_images(path, number)
            return True
        return False
    return True


def _read_text(path: Path) -> bool:
    """A calibration by its suffix; settings and zones by their names."""
    try:
        if path.name == "settings.toml":
            read_settings(path, [])
        elif path.name == "zone.txt":
            zone = path.read_bytes().decode("utf-8", "surrogatepass")
            source = SequenceInfo("x", "folder", Clock.UTC, zone=zone)
            assert hour_of_day(source, 0) is None or not zone_note(source)
            check_zone(zone)
        else:
            calibration_toml(read_calibration(path))
            if path.suffix == ".toml":
                load_toml(path.read_text(), CalibrationFile)
    except EngramError:
        return False
    return True


def _hand_in(case: Case, folder: Path, merges: bool) -> bool:
    path = folder / "thin.engram"
    try:
        kept = case.manifest
        manifest = decode_manifest(kept) if isinstance(kept, bytes) else kept
        assert manifest is not None
        assert case.parts is not None
        _admit(manifest, case.parts, path)
    except EngramError:
        return False
    return _read_map(path, folder, merges)


def _admit(manifest: Manifest, parts: dict[Any, bytes], path: Path) -> None:
    """As the centre does; a stranger can name the content of what it made."""
    try:
        write_checked(manifest, parts, path)
    except EngramError as error:
        found = _FOUND.search(str(error))
        if found is None:
            raise
        named = Manifest(found[1], manifest.revision, manifest.pages)
        write_checked(named, parts, path)
