"""Result of examining a drive: findings, each with value, limit and cure."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.config import plain
from engram.counts import counted


class Severity(StrEnum):
    """How bad a finding is.

    `FATAL`: what is mapped from such a drive is wrong or useless. `WARNING`: it serves less well
    than it could. `NOTE`: something that only some uses need.
    """

    FATAL = "fatal"
    WARNING = "warning"
    NOTE = "note"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong with a drive.

    Attributes:
        code: name of the check, see `CHECKS`.
        severity: how bad it is.
        message: what is wrong, in words.
        value: what was measured.
        limit: what it may be.
        unit: of both.
        cure: what to do.
    """

    code: str
    severity: Severity
    message: str
    value: float
    limit: float
    unit: str
    cure: str

    def text(self) -> str:
        """For people: two lines."""
        measured = measure_text(self.value, self.limit, self.unit)
        return f"{self.severity}: {self.code}: {self.message} ({measured})\n  {self.cure}"


def measure_text(value: float, limit: float, unit: str) -> str:
    """A measured value and its limit, shares of something as percentages."""
    shares = unit.startswith("of the ")
    shown, most = (f"{100 * one:.3g}%" if shares else f"{one:.3g}" for one in (value, limit))
    return f"{shown} {unit}".strip() + f", limit {most}"


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """All findings of an examination, the worst first.

    Attributes:
        frames: how many frames were examined.
        findings: what is wrong.
        untold: checks that could not be made, and what they would need, by code.
        seen: (height, width) bool of the rectified left image, False where it moves with the
            camera; None if nothing does.
    """

    frames: int
    findings: tuple[Finding, ...]
    untold: dict[str, str]
    seen: NDArray[np.bool_] | None = field(default=None, compare=False, repr=False)

    @property
    def fatal(self) -> tuple[Finding, ...]:
        """The findings for which the drive should not be mapped."""
        return tuple(one for one in self.findings if one.severity is Severity.FATAL)

    def text(self) -> str:
        """For people."""
        lines = [one.text() for one in self.findings]
        lines += [f"not checked: {code} needs {needs}" for code, needs in self.untold.items()]
        alarms = sum(one.severity is not Severity.NOTE for one in self.findings)
        found = (
            "nothing wrong"
            if not alarms
            else f"{len(self.fatal)} of {counted(alarms, 'finding')} fatal"
        )
        return "\n".join([f"{counted(self.frames, 'frame')} examined: {found}", *lines])

    def to_dict(self) -> dict[str, Any]:
        """What ``doctor --json`` prints."""
        return {
            "frames": self.frames,
            "fatal": bool(self.fatal),
            "findings": [plain(one) for one in self.findings],
            "untold": self.untold,
        }
