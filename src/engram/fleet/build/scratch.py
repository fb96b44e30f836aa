"""The mapping of one group, and the files of a build: a killed build continues from them."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from engram.counts import counted
from engram.errors import (
    ConfigError,
    MapError,
    MapLockedError,
    SequenceError,
    extra,
    storage_full,
)
from engram.files import WriterLock, current_holder
from engram.fleet.build.orders import BestOrder
from engram.maps.map import Map, open_map
from engram.maps.map_files import copy_map
from engram.monitor import QUIET, Monitor, write_whole
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive


@dataclass(frozen=True, slots=True)
class GroupTask:
    """Sessions to be mapped one after another into a map of their own.

    Attributes:
        sources: paths or fsspec URLs of the drives, in the order of mapping.
    """

    number: int
    path: Path
    sources: Sequence[str]
    settings: Settings
    options: RobotOptions


@dataclass(slots=True)
class GroupResult:
    """The result of mapping a group.

    Attributes:
        seconds: wall time of the runs that mapped it; the last run only, after a worker died.
        sessions: one summary each, as in ``map --json``.
        nodes: of the group's map.
        retries: number of workers that died on it.
    """

    number: int
    seconds: float = 0.0
    cpu_s: float = 0.0
    sessions: list[dict[str, Any]] = field(default_factory=list)
    nodes: int = 0
    retries: int = 0


def map_group(task: GroupTask, monitor: Monitor = QUIET) -> GroupResult:
    """Maps a group's sessions into a map, which is created if missing.

    Sessions that the map holds are skipped. An interrupted session is mapped again from its start,
    so the death of a worker does not change the result.
    """
    result = GroupResult(task.number)
    started, cpu_started = time.perf_counter(), time.process_time()
    with open_map(task.path, create=True) as store, store.writing():
        for interrupted in store.interrupted():
            store.resume_session(interrupted.session.id).abandon()
    for source in task.sources:
        with fetched(source) as drive:
            report = map_drive(task.path, open_drive(drive), task.settings, task.options, monitor)
        if report.interrupted:
            raise KeyboardInterrupt
        result.sessions.append({"source": source, **report.to_dict()})
    with Map.open(task.path) as made:
        result.nodes = made.node_count()
    result.seconds = time.perf_counter() - started
    result.cpu_s = time.process_time() - cpu_started
    return result


def map_group_far_away(task: GroupTask, monitor: Monitor = QUIET) -> tuple[GroupResult, bytes]:
    """Maps a group on a machine that shares no disk with the caller; returns the map's bytes."""
    with tempfile.TemporaryDirectory(prefix="engram-group-") as folder:
        local = replace(task, path=Path(folder) / "group.engram")
        result = map_group(local, monitor)
        whole = Path(folder) / "whole.engram"
        copy_map(local.path, whole)  # without the write-ahead log beside it
        return result, whole.read_bytes()


@contextmanager
def fetched(source: str) -> Iterator[Path]:
    """Local path of a drive; one at a URL is copied."""
    if "://" not in source:
        yield Path(source)
        return
    with extra("cluster", f"{source}: drives at URLs need fsspec"):
        import fsspec
    with tempfile.TemporaryDirectory(prefix="engram-drive-") as folder:
        copy = Path(folder) / source.rstrip("/").rsplit("/", 1)[-1]
        try:
            files, path = fsspec.core.url_to_fs(source)
            files.get(path, str(copy), recursive=files.isdir(path))
        except Exception as error:  # each file system has its own errors
            raise SequenceError(f"{source} cannot be fetched: {error}") from error
        yield copy


Kept = TypeVar("Kept")


@dataclass(frozen=True, slots=True)
class BuildPlan:
    """Inputs of a build up to its merges; equal plans give equal maps of the groups.

    Attributes:
        groups: sessions of each group, in the order of mapping.
        known: sessions that the fleet map had when the build began, sorted.
        complete: whether the fleet map has all groups; the folder is then needed only if `kept`.
        kept: whether the groups' maps are kept after the build.
    """

    groups: list[list[str]]
    known: list[str]
    settings: str
    mapping: dict[str, Any]
    merging: dict[str, Any]
    complete: bool = False
    kept: bool = False

    def same_build(self, other: BuildPlan) -> bool:
        """Whether one build continues the other."""
        return self.same_groups(other) and (self.known, self.merging) == (
            other.known,
            other.merging,
        )

    def same_groups(self, other: BuildPlan) -> bool:
        """Whether both builds have the same maps of the groups."""
        mine, theirs = ((plan.groups, plan.settings, plan.mapping) for plan in (self, other))
        return mine == theirs


@dataclass(frozen=True, slots=True)
class MergingBegun:
    """The order of merging, fixed before the first merge.

    Attributes:
        judge: `JudgeOptions.hash` of the judgement; None if no orders were tried.
        seconds: wall time of each group's committed merge, by its number as text.
    """

    order: list[int]
    judge: str | None = None
    best: BestOrder | None = None
    seconds: dict[str, float] = field(default_factory=dict)


@contextmanager
def keeping(folder: Path) -> Iterator[None]:
    """Converts file system errors in a build's folder into Engram's."""
    try:
        yield
    except OSError as error:
        where = error.filename or folder
        if full := storage_full(error, where):
            raise full from error
        raise MapError(
            f"{where}: {error.strerror or error}; a build keeps its maps in {folder}: it must be "
            "a writable folder, or one that can be made"
        ) from error


def build_folder(centre: Path) -> Path:
    """The folder of a build's intermediate maps."""
    return centre.with_name(f"{centre.name}.build")


@contextmanager
def sole_builder(centre: Path) -> Iterator[None]:
    """Locks a fleet map against other builds, which would write to the same groups' maps.

    The lock file is next to the folder, since the folder is removed and made again. The lock ends
    with its process, so a killed build can continue at once.
    """
    folder = build_folder(centre)
    try:
        lock = WriterLock(folder)
    except MapLockedError as error:
        raise MapLockedError(
            f"{centre} is being built by {current_holder(folder) or 'another process'}; wait until "
            "it is done, or build another one"
        ) from error
    try:
        yield
    finally:
        lock.release()


class Scratch:
    """The folder of a build.

    The plan is written first and removed last, so every other file in the folder belongs to it.

    All methods raise MapError if the folder cannot be read or written, and StorageFullError if no
    space is left.
    """

    def __init__(self, centre: Path) -> None:
        self.centre = centre
        self.folder = build_folder(centre)
        self.plan = self._read_plan()

    @property
    def unfinished(self) -> BuildPlan | None:
        """The plan of an incomplete build; None without one."""
        return None if self.plan is None or self.plan.complete else self.plan

    def begin(self, plan: BuildPlan) -> None:
        """Starts or continues a build; kept maps of the groups are used again."""
        if (unfinished := self.unfinished) is not None:
            if not unfinished.same_build(plan):
                raise ConfigError(
                    f"{self.folder} belongs to another, incomplete build; finish it with its "
                    "own command, or delete the folder"
                )
            self._check_left_out(plan)
        elif self.plan is None:
            self._check_empty()
        elif self.plan.same_groups(plan):
            with keeping(self.folder):
                self._merging_path.unlink(missing_ok=True)
        else:
            self._check_in_centre(self.plan)
            self._clear()
        with keeping(self.folder):
            self.folder.mkdir(exist_ok=True)
        self._write_plan(plan)

    def finish(self) -> None:
        """Marks the build as complete and removes its maps unless they are to be kept.

        If the fleet map no longer has one of their drives, nothing is removed.
        """
        assert self.plan is not None
        missing = _missing(self.centre, self.plan)
        if missing:
            raise MapError(
                f"{self.centre} no longer contains sessions that were merged into it "
                f"({', '.join(missing)}); they may have been reverted. The groups' maps stay in "
                f"{self.folder}"
            )
        self._write_plan(replace(self.plan, complete=True))
        self.remove_leftovers()

    def remove_leftovers(self) -> None:
        """Removes what a complete build was killed before removing."""
        if self.plan is not None and self.plan.complete and not self.plan.kept:
            self._clear()
            with keeping(self.folder):
                self._plan_path.unlink()
                self.folder.rmdir()
            self.plan = None

    def group(self, number: int) -> Path:
        """The map of a group."""
        return self.folder / f"group-{number}.engram"

    @property
    def orders(self) -> Path:
        """Folder of the maps of partial orders."""
        return self.folder / "orders"

    def remember(self, result: GroupResult) -> None:
        """Stores the result of a mapped group."""
        write_kept(self._result_path(result.number), result)

    def result(self, number: int) -> GroupResult | None:
        """The result of mapping a group; None if it is not mapped yet."""
        path = self._result_path(number)
        if not (path.exists() and self.group(number).exists()):
            return None
        return read_kept(path, GroupResult)

    def merging_begun(self) -> MergingBegun | None:
        """The order of an earlier run; None if it has not begun to merge.

        Without a fleet map nothing is merged yet, whatever was stored.
        """
        if not (self.centre.exists() and self._merging_path.exists()):
            return None
        return read_kept(self._merging_path, MergingBegun)

    def remember_merging(self, begun: MergingBegun) -> None:
        """Stores the order and the merges done."""
        write_kept(self._merging_path, begun)

    @property
    def _plan_path(self) -> Path:
        return self.folder / "build.json"

    @property
    def _merging_path(self) -> Path:
        return self.folder / "merging.json"

    def _result_path(self, number: int) -> Path:
        return self.folder / f"group-{number}.json"

    def _read_plan(self) -> BuildPlan | None:
        return read_kept(self._plan_path, BuildPlan) if self._plan_path.exists() else None

    def _write_plan(self, plan: BuildPlan) -> None:
        write_kept(self._plan_path, plan)
        self.plan = plan

    def _check_left_out(self, plan: BuildPlan) -> None:
        """Checks that the fleet map still has the drives that are left out because it had them."""
        gone = sorted(set(plan.known) - sessions_of(self.centre))
        if gone:
            raise ConfigError(
                f"{self.centre} no longer has {len(gone)} of the "
                f"{counted(len(plan.known), 'session')} that it had when this build began "
                f"({gone[0]}); restore it, or delete {self.folder} to build without them"
            )

    def _check_empty(self) -> None:
        """Checks that the folder has no files that a new build would take for its own."""
        with keeping(self.folder):
            if not self.folder.exists():
                return
            strange = [path.name for path in self.folder.iterdir() if path.suffix != ".part"]
        if strange:
            raise ConfigError(
                f"{self.folder} holds {sorted(strange)[0]}, but no plan of a build; delete the "
                "folder, or move it"
            )

    def _check_in_centre(self, plan: BuildPlan) -> None:
        """Checks that the fleet map has all sessions of kept maps before they are removed."""
        missing = _missing(self.centre, plan)
        if missing:
            raise ConfigError(
                f"{self.folder} holds the groups' maps of an earlier build, which is complete, and "
                f"{len(missing)} of their sessions are missing from {self.centre} ({missing[0]}); "
                "move the folder, or delete it"
            )

    def _clear(self) -> None:
        """Removes everything but the plan, results before their maps."""
        with keeping(self.folder):
            for path in sorted(self.folder.iterdir(), key=lambda file: file.suffix != ".json"):
                if path.is_dir():
                    shutil.rmtree(path)
                elif path != self._plan_path:
                    path.unlink()


def sessions_of(centre: Path) -> frozenset[str]:
    """All sessions of a map, partial ones included; none if the map does not exist."""
    if not centre.exists():
        return frozenset()
    with Map.open(centre) as store:
        return frozenset(map(str, store.frontends))


def _missing(centre: Path, plan: BuildPlan) -> list[str]:
    wanted = {session for group in plan.groups for session in group}
    return sorted(wanted - sessions_of(centre))


def read_kept(path: Path, kind: type[Kept]) -> Kept:
    """Reads a file of a build."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (OSError, msgspec.MsgspecError) as error:
        raise ConfigError(f"{path} cannot be read ({error}); delete {path.parent}") from error


def write_kept(path: Path, values: Any) -> None:
    """Writes a file of a build atomically."""
    with keeping(path.parent), write_whole(path) as draft:
        draft.write_bytes(msgspec.json.encode(values))
