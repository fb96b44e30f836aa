"""The matrix of the study of faults: a row for each fault, by halves of its strengths."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from engram_lab.studies.faults.injected import FAULTS
from engram_lab.studies.faults.study import KINDS, Trial

_HEAD = (
    "| fault | strength | trials | frames | fixes | false | events | worst, m | found again after "
    "(median, worst) | never | the doctor objects |",
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
)


def matrix(trials: Sequence[Trial]) -> str:
    """A table in Markdown: faults with weaker and stronger halves of their strengths."""
    by_fault: dict[str, list[Trial]] = defaultdict(list)
    for one in trials:
        by_fault[one.fault].append(one)
    lines = list(_HEAD)
    for fault in (kind for kind in KINDS if kind in by_fault):
        lines += [_row(fault, *part) for part in _parts(fault, by_fault[fault])]
    lines.append(_row("all", "", trials))
    return "\n".join(lines)


def headline(trials: Sequence[Trial]) -> str:
    """What counts, in one line."""
    km = sum(one.driven_m for one in trials) / 1e3
    return (
        f"{len(trials)} trials, {km:.1f} km: {sum(one.events for one in trials)} false events, "
        f"largest error claimed {max((one.worst_m for one in trials), default=0.0):.2f} m"
    )


def _parts(fault: str, rows: Sequence[Trial]) -> list[tuple[str, Sequence[Trial]]]:
    what = FAULTS.get(fault)
    if what is None or what.weakest == what.strongest:
        return [("", rows)]
    middle = float(np.sqrt(what.weakest * what.strongest))
    weak = [one for one in rows if one.strength < middle]
    strong = [one for one in rows if one.strength >= middle]
    spans = ((what.weakest, middle, weak), (middle, what.strongest, strong))
    return [(f"{low:.3g}–{high:.3g} {what.unit}", part) for low, high, part in spans if part]


def _row(fault: str, span: str, rows: Sequence[Trial]) -> str:
    again = [one.again for one in rows if one.again is not None]
    found = f"{np.median(again):.0f}, {max(again)}" if again else "–"
    cells = (
        fault, span, len(rows), sum(one.frames for one in rows), sum(one.fixes for one in rows),
        sum(one.false for one in rows), sum(one.events for one in rows),
        f"{max((one.worst_m for one in rows), default=0.0):.2f}", found,
        sum(one.again is None for one in rows), sum(bool(one.refused) for one in rows),
    )  # fmt: skip
    return "| " + " | ".join(map(str, cells)) + " |"
