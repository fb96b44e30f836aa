"""`--frames START:STOP:STEP`: which frames of a drive are used."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from engram.errors import ConfigError

T = TypeVar("T")

_PART = re.compile(r"[0-9]{1,9}")


@dataclass(frozen=True, slots=True)
class FrameRange:
    """Frames `start`, `start + step`, … below `stop`, counted from 0 in the layout's own order.

    Frames that are left out as bad keep their numbers, so that a range names the same frames with
    and without `skip_bad`.

    Attributes:
        start: first frame, >= 0.
        stop: end, not included; None for all the rest.
        step: distance of successive frames, >= 1.

    Raises:
        ConfigError: a part is negative, the step is 0, or stop is not behind start.
    """

    start: int = 0
    stop: int | None = None
    step: int = 1

    def __post_init__(self) -> None:
        if self.start < 0 or (self.stop is not None and self.stop < 0) or self.step < 1:
            raise ConfigError(
                f"frames {self}: start and stop must be >= 0 and step >= 1 "
                "(counting from the end is not supported)"
            )
        if self.stop is not None and self.stop <= self.start:
            raise ConfigError(f"frames {self}: holds no frame, stop must be larger than start")

    @staticmethod
    def parse(text: str) -> FrameRange:
        """Read START:STOP:STEP, the words of a Python slice; any part may be missing.

        A single number N means the one frame N.

        Raises:
            ConfigError: the text is no such range.
        """
        parts = [part.strip() for part in text.split(":")]
        if len(parts) > 3 or text.strip() == "":
            raise ConfigError(f"frames {text!r}: write START:STOP:STEP, such as 0:100:2")
        for part in parts:
            if part and not _PART.fullmatch(part):
                why = "counts from the end, which is not supported" if part[0] == "-" else "is none"
                raise ConfigError(
                    f"frames {text!r}: {part!r} {why}; each part is a whole number >= 0 or missing"
                )
        start = int(parts[0] or 0)
        if len(parts) == 1:
            return FrameRange(start, start + 1)
        stop = int(parts[1]) if parts[1] else None
        step = int(parts[2]) if len(parts) == 3 and parts[2] else 1
        return FrameRange(start, stop, step)

    def __str__(self) -> str:
        return f"{self.start}:{'' if self.stop is None else self.stop}:{self.step}"

    def indices(self, length: int) -> range:
        """The frames of a drive of `length` frames that are in the range."""
        return range(length)[self.start : self.stop : self.step]

    def of(self, items: Sequence[T]) -> list[T]:
        """The members of `items` that are in the range."""
        return [items[index] for index in self.indices(len(items))]
