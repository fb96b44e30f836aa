"""What a power cut leaves of maps and frame logs, on a disk that keeps only what was synced.

    python -m engram_lab.checks.power_cuts --cuts 2000
    python -m engram_lab.checks.power_cuts --cut 1234     # one of them again, with its details

A child makes a map, merges it into a fleet map and records a frame log; a recorder between it and
the C library notes what it writes, syncs, renames and unlinks (`write_recorder.c`, built here with
`cc`), and each step that it has finished. A cut then takes the first so many of these deeds. What
was synced is there. Of what was not, each write is there, missing, or torn at sectors of 512 bytes,
by chance; of names that were given and taken in a folder, the first so many. This is less than any
file system of today does.

What a finished step had stored must be there: each map must hold what it held after that step or
after a later one, pass its check, and take in one more drive; a frame log must show all its frames.
A map whose making was cut may be missing, or refused by name.
"""

from __future__ import annotations

import os
import random
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache
from pathlib import Path

from engram.errors import EngramError
from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.merging import merge
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.sequences.framelog.reader import FrameLog
from engram_lab.mutations.case import drive_steps, map_steps, record_log
from engram_lab.mutations.forks import Held, held
from engram_lab.programs import Figure, command_line, report
from engram_lab.synthetic_places import drive_of

_SECTOR = 512
_HEAD = struct.Struct("<6q")
_PROMISES = "promises"  # the child adds a line once a step is done
_MAPS, _LOGS = (".engram",), (".framelog",)


class Deed(IntEnum):
    """What the recorder notes."""

    CREATE = 1
    WRITE = 2
    TRUNCATE = 3
    SYNC = 4
    SYNC_FOLDER = 5
    RENAME = 6
    LINK = 7
    UNLINK = 8


_OF_NAMES = frozenset({Deed.CREATE, Deed.RENAME, Deed.LINK, Deed.UNLINK})


@dataclass(frozen=True, slots=True)
class Done:
    """One deed.

    Attributes:
        file: its number.
        path: of a file, or of the folder that is synced.
        data: what is written; of a rename or link, the second path.
    """

    deed: Deed
    file: int
    offset: int
    length: int
    path: str
    data: bytes

    @property
    def names(self) -> tuple[str, ...]:
        """The paths that it gives or removes."""
        return (self.path, self.data.decode()) if self.data else (self.path,)


def read_record(file: Path) -> list[Done]:
    """What was done, in its order."""
    body, at, found = file.read_bytes(), 0, list[Done]()
    while at < len(body):
        deed, number, offset, length, named, size = _HEAD.unpack_from(body, at)
        at += _HEAD.size
        path, data = body[at : at + named].decode(), body[at + named : at + named + size]
        at += named + size
        found.append(Done(Deed(deed), number, offset, length, path, data))
    return found


@dataclass(slots=True)
class Disk:
    """What is on a disk for certain, and what may be: by file, and of names."""

    contents: dict[int, bytearray] = field(default_factory=dict)
    names: dict[str, int] = field(default_factory=dict)
    unsynced: dict[int, list[Done]] = field(default_factory=dict)
    unsynced_names: list[Done] = field(default_factory=list)

    def take(self, done: Done) -> None:
        """The next deed."""
        if done.deed in _OF_NAMES:
            self.unsynced_names.append(done)
        elif done.deed is Deed.SYNC_FOLDER:
            synced = [
                one
                for one in self.unsynced_names
                if Path(done.path) in {Path(name).parent for name in one.names}
            ]
            self.unsynced_names = [one for one in self.unsynced_names if one not in synced]
            for one in synced:
                self.name(one)
        elif done.deed is Deed.SYNC:
            for one in self.unsynced.pop(done.file, ()):
                self.write(one)
        else:
            self.unsynced.setdefault(done.file, []).append(done)

    def name(self, done: Done) -> None:
        """Gives or removes a name."""
        if done.deed is Deed.CREATE:
            self.names[done.path] = done.file
        elif done.deed is Deed.UNLINK:
            self.names.pop(done.path, None)
        elif done.path in self.names:  # else its own creation was lost
            _, other = done.names
            self.names[other] = self.names[done.path]
            if done.deed is Deed.RENAME:
                del self.names[done.path]

    def write(self, done: Done) -> None:
        """Writes or truncates permanently."""
        content = self.contents.setdefault(done.file, bytearray())
        if done.deed is Deed.TRUNCATE:
            del content[done.length :]
            content.extend(bytes(done.length - len(content)))
        else:
            content.extend(bytes(max(done.offset - len(content), 0)))
            content[done.offset : done.offset + done.length] = done.data

    def settle(self, chance: random.Random | None) -> None:
        """The power is cut: what is not synced is there, or not. Without chance, all of it is."""
        count = len(self.unsynced_names)
        for one in self.unsynced_names[: count if chance is None else chance.randint(0, count)]:
            self.name(one)
        for left in self.unsynced.values():
            share = 1.0 if chance is None else chance.choice([0.0, 0.1, 0.5, 0.9, 1.0])
            for one in left:
                if chance is None or chance.random() < share:
                    for part in [one] if chance is None else _torn(one, chance):
                        self.write(part)
        self.unsynced, self.unsynced_names = {}, []

    def lay_out(self, recorded: Path, folder: Path) -> None:
        """Writes the files into a folder, in place of the one that was recorded."""
        for name, number in self.names.items():
            path = folder / Path(name).relative_to(recorded)
            if path.name.endswith("-shm"):
                continue  # memory of processes, not of a disk
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(self.contents.get(number, b""))


def _torn(done: Done, chance: random.Random) -> Iterator[Done]:
    """The sectors of a write that reached the disk: one time in three not all."""
    if done.deed is not Deed.WRITE or chance.random() < 2 / 3:
        yield done
        return
    first = done.offset
    while first < done.offset + done.length:
        end = min(first - first % _SECTOR + _SECTOR, done.offset + done.length)
        if chance.random() < 0.5:
            data = done.data[first - done.offset : end - done.offset]
            yield Done(done.deed, done.file, first, end - first, "", data)
        first = end


# -- what is recorded


def _child(folder: Path) -> None:
    with (folder / _PROMISES).open("w", buffering=1) as promises:
        for step in _steps(folder):
            promises.write(step + "\n")


def _steps(folder: Path) -> Iterator[str]:
    town, fleet = folder / "town.engram", folder / "fleet.engram"
    yield from (f"town: {step}" for step in map_steps(town))
    merge(fleet, [town], MergeOptions(relocaliser="none"))
    yield "fleet: merge"
    with Map.open(town, writes=True) as store:
        yield from (f"town: {step}" for step in drive_steps(store, drive_of("r7", 9_000_000_000)))
    merge(fleet, [town], MergeOptions(relocaliser="none"))
    yield "fleet: merge again"
    record_log(folder / "drive.framelog")
    yield "log: record"


def _record(folder: Path, log: Path) -> None:
    source = Path(__file__).with_name("write_recorder.c")
    library = log.with_suffix(".so")
    compiler = os.environ.get("CC", "cc")
    if sys.platform != "linux" or shutil.which(compiler) is None:
        sys.exit(f"the recorder needs Linux and a C compiler: {compiler} was not found; set CC")
    build = [compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"]
    subprocess.run(build, check=True)
    recorded = {
        "LD_PRELOAD": str(library),
        "RECORDED_FOLDER": str(folder),
        "RECORDED_LOG": str(log),
    }
    command = [sys.executable, "-m", __spec__.name, "--child", str(folder)]
    subprocess.run(command, env={**os.environ, **recorded}, check=True)


# -- what a cut leaves


class Cuts:
    """A recording, and what is left of it after each cut.

    Attributes:
        length: number of deeds.
        promises: by number of deeds, from which on they hold: the steps done.
    """

    def __init__(self, folder: Path) -> None:
        self._recorded, self._work = folder / "recorded", folder / "cut"
        self._recorded.mkdir()
        _record(self._recorded, folder / "deeds")
        self._done = read_record(folder / "deeds")
        self.length = len(self._done)
        number = next(one.file for one in self._done if one.path.endswith(_PROMISES))
        self.promises = [
            (at + 1, one.data.decode().strip())
            for at, one in enumerate(self._done)
            if one.file == number and one.deed is Deed.WRITE
        ]
        self._check_recording()
        self.state_after = cache(self._state_after)

    def _check_recording(self) -> None:
        """All deeds together must leave what the child left."""
        whole = self._laid_out(self.length, None)
        for path in self._recorded.rglob("*"):
            if path.is_file() and not path.name.endswith("-shm"):
                copy = whole / path.relative_to(self._recorded)
                if not copy.exists() or copy.read_bytes() != path.read_bytes():
                    raise AssertionError(f"the recorder missed something of {path.name}")

    def _laid_out(self, cut: int, chance: random.Random | None) -> Path:
        disk = Disk()
        for done in self._done[:cut]:
            disk.take(done)
        disk.settle(chance)
        shutil.rmtree(self._work, ignore_errors=True)
        self._work.mkdir()
        disk.lay_out(self._recorded, self._work)
        return self._work

    def _state_after(self, cut: int) -> dict[str, Held]:
        """What a process killed there leaves, by file: no write is lost."""
        folder = self._laid_out(cut, None)
        return {path.name: held(path) for path in _watched(folder)}

    def fault(self, number: int, seed: int) -> str:
        """What is wrong after a cut; empty if nothing is."""
        chance = random.Random(f"{seed} {number}")
        cut = chance.randint(1, self.length)
        since = max((at for at, _ in self.promises if at <= cut), default=0)
        later = (at + 1 for at in range(cut, self.length) if self._settles(at))
        until = next(later, self.length)
        ends = [since, *(at + 1 for at in range(since, until) if self._settles(at)), until]
        held_then = [self.state_after(end) for end in ends]
        folder = self._laid_out(cut, chance)
        step = next((name for at, name in self.promises if at > cut), "the end")
        for path in sorted({folder / name for name in held_then[0]} | _watched(folder)):
            states = [state[path.name] for state in held_then if path.name in state]
            wrong = _wrong(path, states, required=path.name in held_then[0])
            if wrong:
                return f"deed {cut} of {self.length}, within {step!r}: {path.name}: {wrong}"
        return ""

    def _settles(self, at: int) -> bool:
        """Whether a deed may change what is certain."""
        return self._done[at].deed in {Deed.SYNC, Deed.SYNC_FOLDER} | _OF_NAMES


def _watched(folder: Path) -> set[Path]:
    return {path for path in folder.iterdir() if path.suffix in _MAPS + _LOGS}


def _wrong(path: Path, states: Sequence[Held], *, required: bool) -> str:
    """What is wrong with a file that may be in these states; empty if nothing is."""
    if not path.exists():
        return "it is gone" if required else ""
    try:
        if path.suffix in _LOGS:
            with closing(FrameLog(path)) as log:
                frames = sum(1 for _ in log)
            complete = held(path) in states
            return f"it shows {frames} frames" if required and not complete else ""
        now = held(path)
        if now not in states:
            return "it holds what it never held"
        report = check_file(path)
        if not report.sound:
            return f"it does not pass its check: {report}"
        with Map.open(path, writes=True) as store:
            for _ in drive_steps(store, drive_of("r8", 10_000_000_000)):
                pass
        return "" if check_file(path).sound else "it does not pass its check after one more drive"
    except EngramError as error:
        return f"{type(error).__name__}: {error}" if required else ""


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--cuts", type=int, default=200)
    parser.add_argument("--cut", type=int, help="only this one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--child", type=Path, help="used by the program itself")
    asked = parser.parse_args()
    if asked.child:
        _child(asked.child)
        return
    with tempfile.TemporaryDirectory(prefix="engram-cuts-") as folder:
        cuts = Cuts(Path(folder))
        numbers = range(asked.cuts) if asked.cut is None else [asked.cut]
        faults = 0
        for number in numbers:
            fault = cuts.fault(number, asked.seed)
            if fault:
                faults += 1
                print(f"cut {number}, {fault}", flush=True)
        figures = [
            Figure("steps", len(cuts.promises)),
            Figure("deeds", cuts.length),
            Figure("cuts", len(numbers)),
            Figure("faults", faults),
        ]
        report(figures, asked.json, "power cuts")
    sys.exit(faults > 0)


if __name__ == "__main__":
    main()
