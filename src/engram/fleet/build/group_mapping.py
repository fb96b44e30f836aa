"""Mapping one group of sessions: the work of one build worker."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from engram.errors import MissingExtraError, SequenceError
from engram.maps import Map, copy_map, open_map
from engram.monitor import QUIET, Monitor
from engram.robot import RobotOptions, Settings, map_drive, open_drive


@dataclass(frozen=True, slots=True)
class GroupTask:
    """Sessions to be mapped one after another into a map of their own.

    Attributes:
        number: of the group.
        path: the group's map.
        sources: paths or fsspec URLs of the drives, in the order of mapping.
        settings: the resolved configuration.
        options: how each drive is mapped.
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
        number: of the group.
        seconds: wall time of the runs that mapped it; the last run only, after a worker died.
        cpu_s: processor time of the same runs.
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

    Args:
        task: what to map, and where.
        monitor: receives progress per frame.

    Raises:
        MapError: the map cannot be written.
        SequenceError: a drive cannot be read.
    """
    result = GroupResult(task.number)
    started, cpu_started = time.perf_counter(), time.process_time()
    with open_map(task.path, create=True) as store, store.writing():
        for one in store.interrupted():
            store.resume_session(one.session.id).abandon()
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
        here = replace(task, path=Path(folder) / "group.engram")
        result = map_group(here, monitor)
        whole = Path(folder) / "whole.engram"
        copy_map(here.path, whole)  # without the write-ahead log beside it
        return result, whole.read_bytes()


@contextmanager
def fetched(source: str) -> Iterator[Path]:
    """Local path of a drive; one at a URL is copied.

    Raises:
        MissingExtraError: a URL, and fsspec is not installed.
        SequenceError: the URL cannot be read.
    """
    if "://" not in source:
        yield Path(source)
        return
    try:
        import fsspec
    except ImportError as error:
        raise MissingExtraError(
            f"{source}: drives at URLs need fsspec: pip install 'engram-localisation[cluster]'"
        ) from error
    with tempfile.TemporaryDirectory(prefix="engram-drive-") as folder:
        copy = Path(folder) / source.rstrip("/").rsplit("/", 1)[-1]
        try:
            files, path = fsspec.core.url_to_fs(source)
            files.get(path, str(copy), recursive=files.isdir(path))
        except Exception as error:  # each file system has its own errors
            raise SequenceError(f"{source} cannot be fetched: {error}") from error
        yield copy
