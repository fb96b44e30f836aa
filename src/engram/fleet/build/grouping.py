"""Which sessions are mapped together when a map is built by several workers (method §7)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from random import Random

from engram.errors import ConfigError
from engram.graph.clock import hour_of_day
from engram.graph.model import Session, SessionId
from engram.robot import open_drive, session_of_drive


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive to be mapped.

    Attributes:
        source: path or URL of its frame log or images.
        session: its record in the map.
        frames: number of frames.
    """

    source: str
    session: Session
    frames: int

    @property
    def name(self) -> str:
        """Its name in a file of groups."""
        return PurePosixPath(self.source.rstrip("/")).name


def look_at_drive(path: Path, source: str) -> Drive:
    """Reads what grouping needs of a drive.

    Args:
        path: local path of the drive.
        source: path or URL for the workers.

    Raises:
        SequenceError: it cannot be read.
    """
    sequence = open_drive(path)
    return Drive(source, session_of_drive(sequence), len(sequence))


def group_drives(
    drives: Sequence[Drive],
    grouping: str,
    groups: int,
    seed: int,
    leave_out: Collection[SessionId] = (),
) -> list[list[Drive]]:
    """Groups of drives, each in chronological order; none is empty.

    Args:
        drives: all of them, each once.
        grouping: key of `GROUPINGS`, or path of a file of groups (`read_groups`).
        groups: number of groups; ignored if a file gives them.
        seed: of `random`.
        leave_out: sessions to leave out; if fewer drives than groups remain, each is a group.

    Raises:
        ConfigError: more groups than drives, a drive twice, or a file that does not fit.
    """
    known = {drive.session.id for drive in drives}
    if len(known) < len(drives):
        raise ConfigError("a drive is given twice; give each once")
    wanted = [drive for drive in drives if drive.session.id not in leave_out]
    if grouping not in GROUPINGS:
        named = read_groups(Path(grouping), drives)
        grouped = [[drive for drive in group if drive in wanted] for group in named]
        return [_chronological(group) for group in grouped if group]
    if not 1 <= groups <= len(drives):
        raise ConfigError(f"{groups} groups of {len(drives)} drives: must be 1 to {len(drives)}")
    if not wanted:
        return []
    ordered = GROUPINGS[grouping](_chronological(wanted), seed)
    return [_chronological(group) for group in _split(ordered, min(groups, len(wanted)))]


def read_groups(path: Path, drives: Sequence[Drive]) -> list[list[Drive]]:
    """Groups from a text file: one a line, the names of its drives between spaces; # comments.

    Raises:
        ConfigError: the file cannot be read, or does not name every drive once.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"grouping {str(path)!r} is not one of {', '.join(GROUPINGS)}, and cannot be read as a "
            f"file of groups: {error}"
        ) from error
    named = [words for line in lines if (words := line.split("#")[0].split())]
    by_name = {drive.name: drive for drive in drives}
    names = [name for group in named for name in group]
    if len(by_name) < len(drives):
        raise ConfigError("a file of groups needs drives with different file names; two are alike")
    if sorted(names) != sorted(by_name):
        missing, strange = sorted(set(by_name) - set(names)), sorted(set(names) - set(by_name))
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ConfigError(
            f"{path}: every drive must be named once; missing {missing}, unknown {strange}, "
            f"twice {twice}"
        )
    return [[by_name[name] for name in group] for group in named]


def _chronological(drives: Sequence[Drive], seed: int = 0) -> list[Drive]:
    del seed
    return sorted(drives, key=lambda drive: (drive.session.start_ns, drive.session.id))


def _random(drives: Sequence[Drive], seed: int) -> list[Drive]:
    shuffled = list(drives)
    Random(seed).shuffle(shuffled)
    return shuffled


def _by_condition(drives: Sequence[Drive], seed: int) -> list[Drive]:
    """By light: distance from noon, so that morning and evening are alike (method §2.8)."""
    del seed
    hours = [hour_of_day(drive.session, drive.session.start_ns) for drive in drives]
    unknown = [drive.name for drive, hour in zip(drives, hours, strict=True) if hour is None]
    if unknown:
        raise ConfigError(
            f"grouping by condition needs the hour of day, which is unknown for {unknown}: give "
            "the groups in a file instead"
        )
    from_noon = {
        drive.session.id: abs(12 - (hour or 0.0)) for drive, hour in zip(drives, hours, strict=True)
    }
    return sorted(drives, key=lambda drive: from_noon[drive.session.id])


def _split(ordered: Sequence[Drive], groups: int) -> list[list[Drive]]:
    """Consecutive parts of the order, whose sizes differ by at most one."""
    size, larger = divmod(len(ordered), groups)
    borders = [0]
    for number in range(groups):
        borders.append(borders[-1] + size + (number < larger))
    return [list(ordered[a:b]) for a, b in pairwise(borders)]


GROUPINGS: dict[str, Callable[[Sequence[Drive], int], list[Drive]]] = {
    "chronological": _chronological,
    "random": _random,
    "by-condition": _by_condition,
}
