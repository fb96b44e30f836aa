"""Changes of bytes, pages and logs, as failing disks and cut transfers make them."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

from engram_lab.mutations.case import Case, Samples, Subject

_PAGE = 4096
_LOG_HEADER, _LOG_FRAME = 32, 24 + _PAGE
_RUN = 64


def of_a_map(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Any bytes of a map file without a log."""
    path = Path(shutil.copy(samples.town, folder / "town.engram"))
    return Case(Subject.MAP, _changed(path, chance, _PAGE, 0), path=path)


def of_a_log(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Bytes of the write-ahead log of a map; one that only ends early is an earlier state."""
    path = logged_copy(samples, folder)
    log = path.with_name(f"{path.name}-wal")
    whole = log.read_bytes()
    what = _changed(log, chance, _LOG_FRAME, _LOG_HEADER)
    return Case(Subject.MAP, f"log: {what}", whole.startswith(log.read_bytes()), path)


def of_a_map_with_a_log(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Bytes of a map file that has a log."""
    path = logged_copy(samples, folder)
    return Case(Subject.MAP, _changed(path, chance, _PAGE, 0), path=path)


def of_a_drive(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Any bytes of a frame log or a flight record."""
    source = chance.choice([samples.framelog, samples.flight])
    path = Path(shutil.copy(source, folder / source.name))
    return Case(Subject.DRIVE, _changed(path, chance, _PAGE, 0), path=path)


def logged_copy(samples: Samples, folder: Path) -> Path:
    """A copy of the map with a log, log included."""
    path = folder / "logged.engram"
    for suffix in ("", "-wal"):
        shutil.copyfile(f"{samples.logged}{suffix}", f"{path}{suffix}")
    return path


def _changed(path: Path, chance: random.Random, page: int, first: int) -> str:
    """Changes a file; says how."""
    body = bytearray(path.read_bytes())
    how = chance.choice(list(_WAYS))
    what = _WAYS[how](body, chance, page, first)
    path.write_bytes(body)
    return f"{how} {what}"


def _flip(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    del page, first
    places = [chance.randrange(len(body)) for _ in range(chance.choice([1, 1, 1, 2, 8]))]
    for at in places:
        body[at] ^= 1 << chance.randrange(8)
    return f"at {places}"


def _head(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    del page, first
    at = chance.randrange(100)
    body[at] = chance.choice([0, 1, 0x7F, 0x80, 0xFF, chance.randrange(256)])
    return f"at {at}"


def _overwrite(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    del page, first
    at, length = chance.randrange(len(body)), chance.randint(1, _RUN)
    run = chance.choice([bytes(length), b"\xff" * length, chance.randbytes(length)])
    body[at : at + length] = run[: len(body) - at]
    return f"{length} bytes at {at}"


def _cut(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    at = chance.randrange(len(body))
    if chance.random() < 0.5:
        at = min(len(body), first + page * ((at - first) // page)) if at > first else first
    del body[at:]
    return f"at {at}"


def _append(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    del first
    run = chance.choice([bytes(page), chance.randbytes(page), bytes(body[-page:])])
    body += run[: chance.choice([page, chance.randint(1, page)])]
    return f"to {len(body)} bytes"


def _exchange(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    count = (len(body) - first) // page
    a, b = (first + page * chance.randrange(count) for _ in range(2))
    one, other = bytes(body[a : a + page]), bytes(body[b : b + page])
    body[a : a + page], body[b : b + page] = other, one
    return f"pages at {a} and {b}"


def _lose(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    at = first + page * chance.randrange((len(body) - first) // page)
    if chance.random() < 0.5:
        body[at : at + page] = bytes(page)
        return f"page at {at} to zeros"
    del body[at : at + page]
    return f"page at {at}"


_WAYS = {
    "flip": _flip,
    "head": _head,
    "overwrite": _overwrite,
    "cut": _cut,
    "append": _append,
    "exchange": _exchange,
    "lose": _lose,
}
