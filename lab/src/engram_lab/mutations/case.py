"""One changed file, or hand-in."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TypeAlias

from engram.transfers import PartHash
from engram.transfers.manifest import Manifest
from engram_lab.mutations.samples import Samples


class Subject(StrEnum):
    """What was changed."""

    MAP = "map"
    DRIVE = "drive"
    HANDIN = "hand-in"
    TEXT = "text"


@dataclass(frozen=True, slots=True)
class Case:
    """A changed thing.

    Attributes:
        subject: its kind.
        what: the change, in words.
        sealed: whether it is sound in itself: its checksums were made right again, as a stranger
            does and damage never, or it is what the file once was.
        path: the file; None for a hand-in.
        manifest: of the hand-in, JSON; None for a file.
        parts: of the hand-in.
    """

    subject: Subject
    what: str
    sealed: bool = False
    path: Path | None = None
    manifest: Manifest | bytes | None = None
    parts: dict[PartHash, bytes] | None = None


# Changes a copy of a sample, made in the folder.
Change: TypeAlias = Callable[[Samples, Path, random.Random], Case]
