"""The tables of the study of faults: a row for each fault, by halves of its strengths."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from engram_lab.studies.faults.real import DRIVES
from engram_lab.studies.faults.staging import KINDS, STRENGTHS
from engram_lab.studies.faults.trials import Trial

_FIXES = (
    "trials", "frames", "fixes", "right fixes lost", "false", "events", "worst, m",
    "found again after (median, worst)", "never", "the doctor objects",
)  # fmt: skip
_MAPS = (
    "drives", "refused", "nodes", "edges", "join two places", "of drives not refused",
    "of odometry", "worst, m",
)  # fmt: skip


def page(trials: Sequence[Trial]) -> str:
    """Headline and tables in Markdown: what robots claimed, and what was done to maps."""
    parts = [headline(trials), _table(_FIXES, trials, _fixes)]
    mapped = [one for one in trials if one.nodes is not None]
    if mapped:
        parts += ["Drives mapped with `--force`:", _table(_MAPS, mapped, _maps)]
    return "\n\n".join(parts) + "\n"


def headline(trials: Sequence[Trial]) -> str:
    """What counts, in one line."""
    if not trials:
        return "no trials"
    km = sum(one.driven_m for one in trials) / 1e3
    events, worst_m = sum(one.events for one in trials), max(one.worst_m for one in trials)
    made_by = " and ".join(sorted({one.made_by for one in trials} - {""})) or "earlier versions"
    return (
        f"{len(trials)} trials of {made_by}, {km:.1f} km: {events} false events, "
        f"largest error claimed {worst_m:.2f} m"
    )


def _table(
    head: Sequence[str],
    trials: Sequence[Trial],
    cells: Callable[[Sequence[Trial]], Sequence[object]],
) -> str:
    """Faults with weaker and stronger halves of their strengths, real clips, all."""
    lines = [_line("fault", "strength", *head), _line(*["---"] * (2 + len(head)))]
    by_fault: dict[str, list[Trial]] = defaultdict(list)
    for one in trials:
        by_fault[one.fault].append(one)
    for fault in (kind for kind in KINDS if kind in by_fault):
        lines += [_line(fault, span, *cells(part)) for span, part in _parts(fault, by_fault[fault])]
    real = [one for one in trials if one.clip.startswith(tuple(DRIVES))]
    if real:
        lines.append(_line("all on real clips", "", *cells(real)))
    return "\n".join([*lines, _line("all", "", *cells(trials))])


def _parts(fault: str, rows: Sequence[Trial]) -> Iterator[tuple[str, Sequence[Trial]]]:
    what = STRENGTHS.get(fault)
    if what is None or what.weakest == what.strongest:
        yield "", rows
        return
    middle = float(np.sqrt(what.weakest * what.strongest))
    weak = [one for one in rows if one.strength < middle]
    strong = [one for one in rows if one.strength >= middle]
    for low, high, part in ((what.weakest, middle, weak), (middle, what.strongest, strong)):
        if part:
            yield f"{low:.3g}–{high:.3g} {what.unit}", part


def _fixes(rows: Sequence[Trial]) -> Sequence[object]:
    again = [one.again for one in rows if one.again is not None]
    expected = sum(one.expected for one in rows)
    return (
        len(rows), sum(one.frames for one in rows), sum(one.fixes for one in rows),
        f"{sum(one.lost for one in rows)} of {expected}" if expected else "–",
        sum(one.false for one in rows), sum(one.events for one in rows),
        f"{max((one.worst_m for one in rows), default=0.0):.2f}",
        f"{np.median(again):.0f}, {max(again)}" if again else "–",
        sum(one.again is None for one in rows), sum(bool(one.refused) for one in rows),
    )  # fmt: skip


def _maps(rows: Sequence[Trial]) -> Sequence[object]:
    return (
        len(rows), sum(bool(one.map_refused) for one in rows), sum(one.nodes or 0 for one in rows),
        sum(one.edges or 0 for one in rows), sum(one.joined for one in rows),
        sum(one.joined for one in rows if not one.map_refused),
        sum(one.joined_odometry for one in rows),
        f"{max((one.worst_edge_m for one in rows), default=0.0):.2f}",
    )  # fmt: skip


def _line(*cells: object) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"
