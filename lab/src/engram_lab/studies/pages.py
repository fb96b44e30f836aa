"""The figures of README, docs and reports, drawn from the tables that the repository keeps.

    python -m engram_lab.studies.pages keep results    # done studies' tables → lab/reports/tables
    python -m engram_lab.studies.pages draw            # tables → blocks and pictures of the pages
    python -m engram_lab.studies.pages release         # fails where a figure is of an older version

A block of a page stands between ``<!-- drawn: NAME -->`` and ``<!-- /drawn -->``. `make test` fails
where a block or a picture is not what its table gives. A block of an older method or world says so.
Figures that are still copied by hand stand below ``<!-- by hand: STUDY, … -->``: `release` fails.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from engram.errors import InputError
from engram_lab.intervals import Interval, Resamples, SessionSums, difference
from engram_lab.studies.budgets import in_short
from engram_lab.studies.evidence import MANIFEST, STUDIES, State, read_manifest
from engram_lab.studies.faults.staging import ELSEWHERE
from engram_lab.studies.month import compared
from engram_lab.studies.page_pictures import pictures
from engram_lab.studies.paper_figures import Row, pooled, read, sessions_of, share_of, usual
from engram_lab.studies.plan import table
from engram_lab.studies.ranking_report import is_wet
from engram_lab.studies.year import quarters

# Below the root of a checkout.
TABLES, PICTURES = "lab/reports/tables", "docs/pictures"
_BLOCK = re.compile(r"(<!-- drawn: ([\w-]+) -->\n).*?(<!-- /drawn -->)", re.DOTALL)
_BY_HAND = re.compile(r"<!-- by hand: ([\w, -]+?) -->")
# Under this key a picture remembers what it was drawn from.
_SOURCE = "Source"


class Figures:
    """The figures that a program of the laboratory wrote as JSON."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._parts: dict[str, list[dict[str, Any]]] = json.loads(path.read_text(encoding="utf-8"))

    def of_part(self, part: str) -> dict[str, float]:
        """All of a part, by name."""
        return {one["name"].strip(): float(one["value"]) for one in self._parts[part]}

    def value(self, part: str, name: str, below: str = "") -> float:
        """One by its name, or the first of another name below it."""
        rows = next((some for title, some in self._parts.items() if title.startswith(part)), [])
        names = [one["name"].strip() for one in rows]
        if name in names:
            start = names.index(name)
            wanted = below or name
            if wanted in names[start:]:
                return float(rows[names.index(wanted, start)]["value"])
        raise InputError(f"{self._path}: no figure {name!r} {below!r} of {part!r}")


def real_images(tables: Path) -> Iterator[str]:
    """What the real clips give, for docs/evidence.md."""
    found = Figures(tables / "real-images/figures.json")
    near = "within 0.25 m"
    revisits = f"EuRoC V1_01, revisits, {near}"
    colour = f"colour rig at the same instant, {near}"
    yield from (
        "| what | set-up | result |",
        "| --- | --- | --- |",
        "| odometry drift over 10–50 m | KITTI 06, its first 51 frames, full size | "
        f"{found.value('odometry', 'translation over 10–50 m segments'):.2f} %, "
        f"{found.value('odometry', 'rotation'):.3f} °/m |",
        "| even frames mapped, odd frames localised | the same frames: one drive with itself, an "
        f"easy test | {found.value('even_odd', 'localised'):.0f} %, median error "
        f"{found.value('even_odd', 'localised', 'error, median'):.2f} cm |",
        "| matching over 8.4 m of viewing distance | the same road | "
        f"{found.value('basin', f'KITTI 06, 8.4 m apart, {near}'):.0f} % {near} |",
        "| one rig maps, the other localises | KITTI raw 0001, grey and colour | "
        f"{found.value('cross_rig', colour):.0f} %, median "
        f"{found.value('cross_rig', colour, 'error, median'):.1f} cm |",
        "| revisits after more than 10 s | EuRoC V1_01, 85 pairs | "
        f"{found.value('revisits', revisits):.1f} % {near}, "
        f"{found.value('revisits', revisits, 'passed but further off'):.0f} further off, median "
        f"{found.value('revisits', revisits, 'error, median'):.1f} cm |",
    )


def real_images_in_short(tables: Path) -> Iterator[str]:
    """The same for README."""
    found = Figures(tables / "real-images/figures.json")
    near = "within 0.25 m"
    revisits = f"EuRoC V1_01, revisits, {near}"
    colour = f"colour rig at the same instant, {near}"
    yield from (
        "| on real images | result |",
        "| --- | --- |",
        "| KITTI 06, its first 5 s: every other frame mapped, the rest localised (an easy test) | "
        f"{found.value('even_odd', 'localised'):.0f} %, median error "
        f"{found.value('even_odd', 'localised', 'error, median'):.2f} cm |",
        "| EuRoC V1_01, 85 revisits of a room after 10 s and more | "
        f"{found.value('revisits', revisits):.1f} % {near}, "
        f"{found.value('revisits', revisits, 'passed but further off'):.0f} further off |",
        "| KITTI raw 0001: one pair of cameras maps, another localises | "
        f"{found.value('cross_rig', colour):.0f} %, median error "
        f"{found.value('cross_rig', colour, 'error, median'):.1f} cm |",
    )


_PROCESSORS = {
    "v4": "x86-64 with AVX-512",
    "v3": "x86-64 with AVX2",
    "generic": "any x86-64",
}


def robot_needs(tables: Path) -> Iterator[str]:
    """Processor time of a step."""
    found = Figures(tables / "robot-needs/figures.json")
    yield from ("| processor | 512×384 | 1226×370 |", "| --- | --- | --- |")
    for isa, words in _PROCESSORS.items():
        times_ms = (
            found.value(f"{isa}, {size}", "processor time of a step, mean")
            for size in ("512", "full")
        )
        yield f"| {words} | {' | '.join(f'{one:.1f} ms' for one in times_ms)} |"


# Stages of `engram lab bench`, without their sizes.
_STAGES: Mapping[str, str] = {
    "front-end and odometry": "frontend_odometry",
    "the same with the window": "frontend_odometry_windowed",
    "an attempt that succeeds": "attempt",
    "an attempt in vain": "attempt_hopeless",
    "a localised robot's step": "robot_step",
}


def bench(tables: Path) -> Iterator[str]:
    """Time of the stages, and how much longer a plain pipeline takes."""
    found = json.loads((tables / "bench/1.txt").read_text(encoding="utf-8"))
    isa = {"v4": "AVX-512", "v3": "AVX2"}.get(found["machine"]["isa"], "neither AVX2 nor AVX-512")
    yield f"| median on one core, {isa} | 512×384 | 1226×370 | OpenCV pipeline takes |"
    yield "| --- | --- | --- | --- |"
    for words, stage in _STAGES.items():
        small, full = (found["stages"][f"{stage}_{size}"] for size in ("512", "full"))
        ratios = [one["ratio"] for one in (small, full) if one["ratio"]]
        longer = f"{min(ratios):.0f} to {max(ratios):.0f} times as long" if ratios else ""
        yield f"| {words} | {small['ms']:.2g} ms | {full['ms']:.2g} ms | {longer} |"


def centre(tables: Path) -> Iterator[str]:
    """What a centre of fifty robots answers in time, and takes."""
    found = Figures(tables / "centre/figures.json").of_part("50 agents, 20000 nodes, 6 minutes")
    within = found["answers within 0.2 s"]
    yield from (
        "| 50 robots, six minutes, 20,000 nodes in the map | |",
        "| --- | --- |",
        f"| drives handed in | {found['forays handed in']:.0f} |",
        f"| answers; within 0.2 s; failed | {found['answers']:,.0f}; {within:.1f} %; "
        f"{found['server errors']:.0f} |",
        f"| 50 nodes merged, of a core | {found['the same, of a core of the centre']:.1f} s |",
        f"| memory of the centre | {found[_CENTRE]:.1f} GB |",
        "| a download, first byte: for the first robot; for a second one | "
        f"{found['first robot' + _FIRST_BYTE]:.2f}; {found['second robot' + _FIRST_BYTE]:.2f} s |",
    )


_CENTRE, _FIRST_BYTE = "memory of the centre's processes", "'s download, first byte"


def kills(tables: Path) -> Iterator[str]:
    """How many maps outlived a kill of the process that mapped."""
    lines = (tables / "kills/1.txt").read_text(encoding="utf-8").splitlines()
    killed = [json.loads(line) for line in lines if line.startswith("{")]
    good, within = (sum(one[name] for one in killed) for name in ("good", "within_commit"))
    yield (
        f"{good} of {len(killed)} maps were sound after `kill -9` amid mapping, {within} of these "
        "amid a commit, and their drives went on or were closed"
    )
    yield "(`python -m engram_lab.checks.kill_mapping`)."


def power_cuts(tables: Path) -> Iterator[str]:
    """What power cuts leave of maps."""
    found = Figures(tables / "power-cuts/figures.json")
    cuts, faults = (int(found.value("power cuts", name)) for name in ("cuts", "faults"))
    yield (
        f"{cuts:,} power cuts amid mapping, merging and forgetting, on a disk that keeps only what "
        "was synced, lost"
    )
    yield f"{_none(faults)} of what was stored (`python -m engram_lab.checks.power_cuts`)."


def mutations(tables: Path) -> Iterator[str]:
    """What damaged and hostile files do to their readers."""
    counts = Figures(tables / "mutations/figures.json").of_part("mutations")
    faults = int(sum(counts.values()) - counts["read"] - counts["refused"])
    yield (
        f"Of {int(sum(counts.values())):,} maps, drives, hand-ins and texts with damage or malice "
        f"in them, {_none(faults)} crashed"
    )
    yield (
        "a reader, hung it, ran code or passed for sound although it had changed "
        "(`python -m engram_lab.checks.mutations`)."
    )


_FAULTS_IN_SHORT = re.compile(
    r"(?P<trials>\d+) trials of .*, (?P<km>[\d.]+) km: (?P<events>\d+) false events, "
    r"largest error claimed (?P<worst_m>[\d.]+) m"
)


def faults(tables: Path) -> Iterator[str]:
    """What robots claim when something is wrong, in a sentence."""
    rows = _faults_by_kind(tables)
    found = _FAULTS_IN_SHORT.match((tables / "faults/faults.md").read_text(encoding="utf-8"))
    assert found is not None
    yield (
        f"In {int(found['trials']):,} short drives with one of {len(rows) - 1} faults injected, "
        f"from swapped cameras to set clocks, false fixes occur {found['events']} times, the worst"
    )
    yield f"{found['worst_m']} m off (`lab/reports/faults.md`)."


def faults_by_kind(tables: Path) -> Iterator[str]:
    """The same by faults that cost fixes or edges, whatever their strength."""
    yield "| fault | trials | lost | events | worst, m | refused | wrong edges |"
    yield "| --- |" + " --- |" * 6
    for fault, one in _faults_by_kind(tables).items():
        known = one["of"] if fault not in ELSEWHERE else 0
        if not (one["events"] or one["joined"] or (known and one["lost"] > _FEW * known)):
            continue
        lost = f"{100 * one['lost'] / known:.0f} %" if known else ""
        yield (
            f"| {fault} | {one['trials']:.0f} | {lost} | {one['events']:.0f} "
            f"| {one['worst_m']:.2f} | {one['refused']:.0f} | {one['joined']:.0f} |"
        )


def _faults_by_kind(tables: Path) -> dict[str, dict[str, float]]:
    """Sums over the strengths of each fault, in the order of the study's table."""
    kinds: dict[str, dict[str, float]] = {}
    for line in (tables / "faults/faults.md").read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if cells[0] in ("fault", "---") or cells[0].startswith("all") or len(cells) < 10:
            continue
        one = kinds.setdefault(cells[0], dict.fromkeys(_FAULT_SUMS, 0.0))
        if len(cells) == 12:  # what was claimed
            lost, _, known = cells[5].partition(" of ")
            counts = (cells[2], cells[4], lost if known else "0", known or "0", cells[7])
            for name, count in zip(_FAULT_SUMS, counts, strict=False):
                one[name] += float(count)
            one["worst_m"] = max(one["worst_m"], float(cells[8]))
        else:  # what was mapped
            one["refused"] += float(cells[3])
            one["joined"] += float(cells[6])
    return kinds


# A smaller share of a fault's right fixes is not worth a row.
_FEW = 0.1
_FAULT_SUMS = ("trials", "fixes", "lost", "of", "events", "worst_m", "refused", "joined")


def _none(count: int) -> str:
    return f"{count:,}" if count else "none"


def hand_ins(tables: Path) -> Iterator[str]:
    """What an evening of hand-ins costs a centre."""
    found = Figures(tables / "hand-ins/figures.json")
    evening = "40 hand-ins of 300 nodes into 100000"
    failed = int(found.value(evening, "hand-ins failed"))
    ratio = found.value(evening, "a hand-in, seconds of a core: last by first medians")
    yield (
        "Of 40 drives of 300 nodes, handed in at once to 100,000 nodes, "
        f"{_none(failed)} failed. To merge them took"
    )
    yield (
        f"{found.value(evening, 'of a core, merging'):.1f} min of a core, the last five "
        f"{ratio:.2f} times as long as the first (`engram_lab.checks.hand_ins`)."
    )


# What a city costs, by the names that the study of its growth gives to parts of a row.
_COSTS: Mapping[str, tuple[str, ...]] = {
    "open and first step at a known place, s": ("open and first step (s)",),
    "a step; its 99th percentile, ms": ("step (ms)", "step, 99th percentile (ms)"),
    "lost: open and first proposals, s": ("lost: open and first proposals (s)",),
    "mapping: open and first step, s; a step, ms": (
        "mapping: open and first step (s)",
        "mapping: step (ms)",
    ),
    "memory of a robot; lost; mapping, MB": (
        "memory (MB)",
        "lost: memory (MB)",
        "mapping: memory (MB)",
    ),
    "commit of 1; 50 nodes, s": ("commit, 1 nodes (s)", "commit, 50 nodes (s)"),
    "`info`; `log`; `show NODE`, s": ("info (s)", "log (s)", "show NODE (s)"),
    "`diff`; `check --since`; `revert` of a drive, s": (
        "diff (s)",
        "check --since (s)",
        "revert (s)",
    ),
    "merge of 50; 500 nodes, beyond the replay, s": (
        "merge, 50 nodes, beyond the replay (s)",
        "merge, 500 nodes, beyond the replay (s)",
    ),
    "download of a region; by hour and paths; by bytes, of 2,000 nodes, s": (
        "download region, 2,000 nodes (s)",
        "download tod+paths of 2,000 nodes (s)",
        "download 5 MB of 2,000 nodes (s)",
    ),
    "`plot`, s": ("plot (s)",),
}


def _cities(tables: Path) -> list[dict[str, float]]:
    """The figures of each city, the smallest first."""
    cities: list[dict[str, float]] = json.loads((tables / "scale/1.txt").read_text("utf-8"))
    return sorted(cities, key=lambda one: one["nodes"])


def scale(tables: Path) -> Iterator[str]:
    """What grows with the map, and what does not: the smallest and the largest city."""
    known = _cities(tables)
    cities = [known[0], known[-1]]
    sizes = (f"{int(one['nodes']):,}" for one in cities)
    yield f"| processor time; nodes | {' | '.join(sizes)} |"
    yield "| --- |" + " --- |" * len(cities)
    for words, names in _COSTS.items():
        cells = ("; ".join(_digits(one[name]) for name in names) for one in cities)
        yield f"| {words} | {' | '.join(cells)} |"


def _digits(value: float) -> str:
    """Two digits, or all before the point."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def scale_in_short(tables: Path) -> Iterator[str]:
    """The largest city, for docs/evidence.md."""
    city = _cities(tables)[-1]
    yield (
        f"In a synthetic city of {int(city['nodes']):,} nodes a robot takes its first step after "
        f"{city['open and first step (s)']:.2f} s of processor time, with "
        f"{city['memory (MB)']:.0f} MB. A lost one has its"
    )
    yield (
        f"first proposals after {city['lost: open and first proposals (s)']:.2f} s, with "
        f"{city['lost: memory (MB)']:.0f} MB (`lab/reports/performance.md`)."
    )


# Conditions, as docs/eyes.md has them.
_SEEN = ("morning / night", "morning / snow", "rain / rain again")


def eyes(tables: Path) -> Iterator[str]:
    """What each kind recognises, and what it takes to describe."""
    rows = read(tables / "eyes/eyes.csv")

    def value(kind: str, where: str, what: str) -> Row:
        wanted = kind, where, what
        return next(one for one in rows if (one["kind"], one["where"], one["what"]) == wanted)

    visits = "random visits, ≥ 20 inliers"
    yield f"| kind | {' | '.join(_SEEN)} | look-alikes | 600 corners, AVX-512 |"
    yield f"| --- |{' --- |' * (len(_SEEN) + 2)}"
    for kind in ("brief", "net"):
        seen = [value(kind, "towns 1, 4", what) for what in _SEEN]
        cells = [one["value"] for one in seen]
        wrong = value(kind, "towns 207, 208", visits)
        time = value(kind, "v4", "600 corners described, ms added to a frame")
        cells += [wrong["wrong"], f"{float(time['value']):.1f} ms"]
        yield f"| `{kind}` | {' | '.join(cells)} |"


# What a page shows; the bound is in the picture.
_RANKED = ("distance", "path", "recall")
_LANES = ("1", "2", "4")
_LEVEL = "with 90 % intervals over drives"


def _percent(row: Row, column: str) -> str:
    """A share with its interval, if the row has one."""
    ends = [row.get(f"{column}{end}", "") for end in ("_low", "_high")]
    text = f"{100 * float(row[column]):.2f}"
    return (
        f"{text} ({' … '.join(f'{100 * float(one):.2f}' for one in ends)})" if all(ends) else text
    )


def ranking(tables: Path, study: str = "ranking") -> Iterator[str]:
    """[L15]'s P(> 10 m) by policy and lanes, and the route missed."""
    rows = pooled(read(tables / study / "summary.csv"))
    whole = {(one["policy"], one["lanes"]): one for one in rows if not one["map_sessions"]}
    some = whole[_RANKED[0], _LANES[0]]
    yield (
        f"P(> 10 m); route not localised, per cent, {_LEVEL}; {some['sessions']} drives, "
        f"{float(some['driven_m']) / 1e3:.1f} km:"
    )
    yield from ("", f"| policy, lanes | {' | '.join(_LANES)} |", f"| --- |{' --- |' * len(_LANES)}")
    for policy in _RANKED:
        cells = (
            f"{100 * float(row['p_gt_10m']):.2f}; {_percent(row, 'share_not_localised')}"
            for row in (whole[policy, lanes] for lanes in _LANES)
        )
        yield f"| `{policy}` | {' | '.join(cells)} |"


def _ranked(groups: Mapping[str, Sequence[Row]]) -> Iterator[str]:
    """The same by groups of drives, from the rows of sessions."""
    yield f"P(> 10 m); route not localised, per cent, {_LEVEL}:"
    yield from ("", f"| drives | policy | {' | '.join(_LANES)} |")
    yield f"| --- | --- |{' --- |' * len(_LANES)}"
    for words, rows in groups.items():
        first = f"{len({one['drive'] for one in rows})} {words}"
        for policy in _RANKED:
            cells = []
            for lanes in _LANES:
                own = [one for one in rows if (one["policy"], one["lanes"]) == (policy, lanes)]
                failed, gone = (share_of(own, name) for name in ("p_gt_10m", "share_not_localised"))
                cells.append(
                    f"{failed.estimate:.2f}; {gone.estimate:.2f} ({gone.low:.2f} … {gone.high:.2f})"
                )
            yield f"| {first} | `{policy}` | {' | '.join(cells)} |"
            first = ""


def ranking_wet(tables: Path) -> Iterator[str]:
    """By drives on dry roads and in rain, through one town."""
    rows = usual(read(tables / "ranking-wet/sessions.csv"))
    yield from _ranked(
        {
            "dry": [one for one in rows if not is_wet(one["drive"])],
            "in rain": [one for one in rows if is_wet(one["drive"])],
        }
    )


def ranking_keble(tables: Path) -> Iterator[str]:
    """By bicycle through crowds."""
    yield from _ranked({"by bicycle": usual(read(tables / "ranking-keble/sessions.csv"))})


def starved(tables: Path) -> Iterator[str]:
    """The same with a front-end as weak as the paper's, and how fast its maps grow."""
    yield from ranking(tables, "starved")
    maps = read(tables / "starved/maps.csv")
    missed, per_m = (
        float(np.mean([float(one[name]) for one in maps]))
        for name in ("share_not_localised", "nodes_per_m_not_localised")
    )
    yield ""
    yield (
        f"While it was built {100 * missed:.0f} % were not localised: {per_m:.2f} nodes per metre "
        "not localised (the paper's 0.81)."
    )


# Conditions of the study, with how they are called together.
_TOGETHER = {"rain by day, 2": "rain by day", "rain at night, 2": "rain at night"}
# What may be mapped, as the tables have it.
_MAPPED = {
    "0 2": "a morning and a night mapped",
    "0": "the morning alone",
    "2": "the night alone",
}
_KINDS = ("brief", "net")


def conditions(tables: Path) -> Iterator[str]:
    """What is localised by condition and what is mapped; false fixes behind a semicolon."""
    rows = read(tables / "conditions/conditions.csv")
    towns = sorted({row["town"] for row in rows})
    frames = sum(int(row["frames"]) for row in rows if row["mapped"] == "0 2")
    yield (
        "Right fixes of all frames, per cent; behind a semicolon false ones, further than 1 m or "
        f"5° off, where there are any. Towns {' and '.join(towns)}, each drive once, {frames:,} "
        "frames in the first column:"
    )
    yield from ("", f"| live | {' | '.join(_MAPPED.values())} |")
    yield f"| --- |{' --- |' * len(_MAPPED)}"
    for name in dict.fromkeys(_TOGETHER.get(row["condition"], row["condition"]) for row in rows):
        some = [row for row in rows if _TOGETHER.get(row["condition"], row["condition"]) == name]
        cells = (_right([row for row in some if row["mapped"] == one]) for one in _MAPPED)
        yield f"| {name} | {' | '.join(cells)} |"


def _right(rows: Sequence[Row]) -> str:
    frames, right, false = (
        sum(int(row[name]) for row in rows) for name in ("frames", "right", "false")
    )
    if not frames:
        return ""
    return f"{100 * right / frames:.1f}" + (f"; {false}" if false else "")


def kinds(tables: Path) -> Iterator[str]:
    """Processor time of a step by kind and instruction set."""
    found = Figures(tables / "robot-needs/figures.json")
    yield f"| processor time of a step, 512×384 | {' | '.join(f'`{one}`' for one in _KINDS)} |"
    yield f"| --- |{' --- |' * len(_KINDS)}"
    for isa, words in _PROCESSORS.items():
        titles = (f"{isa}, 512" + (f", {kind}" if kind != _KINDS[0] else "") for kind in _KINDS)
        times_ms = (found.value(title, "processor time of a step, mean") for title in titles)
        yield f"| {words} | {' | '.join(f'{one:.1f} ms' for one in times_ms)} |"


def year(tables: Path) -> Iterator[str]:
    """A year in one map, by quarters, and in maps that forget."""
    names = ("driven_m", "far_m", "share_not_localised", "saved", "forgotten", "nodes",
             "size_bytes", "attempts_per_frame")  # fmt: skip
    rows = [
        {"arm": row["arm"], **{name: float(row[name]) for name in names}}
        for row in read(tables / "year/drives.csv")
    ]
    found = list(quarters(rows))
    yield "| by quarters | nodes saved a km | route missed, % | nodes at last |"
    yield "| --- | --- | --- | --- |"
    for arm in dict.fromkeys(row["arm"] for row in found):
        own = [row for row in found if row["arm"] == arm]
        saved = ", ".join(f"{row['nodes saved a km']:.0f}" for row in own)
        missed = ", ".join(f"{row['route not localised, %']:.1f}" for row in own)
        yield f"| {arm} | {saved} | {missed} | {own[-1]['nodes']:.0f} |"


def month(tables: Path) -> Iterator[str]:
    """Thirty days of a fleet whose map has a cap, or none."""
    rows = [
        {name: value if name in ("arm", "drive") else float(value) for name, value in row.items()}
        for row in read(tables / "month/drives.csv")
    ]
    yield from table(list(compared(rows)))


def _sums(rows: Sequence[Row], drives: Iterable[tuple[str, str]]) -> SessionSums:
    by_drive = {(one["fold"], one["drive"]): one for one in rows}
    wanted = [by_drive[one] for one in drives]
    driven_m = np.array([float(one["driven_m"]) for one in wanted])
    share = np.array([float(one["share_not_localised"]) for one in wanted])
    return SessionSums(share * driven_m, driven_m)


def _points(rows: Sequence[Row], others: Sequence[Row]) -> str:
    """Both shares of the drives that both have, and their paired difference in points."""
    common = {(one["fold"], one["drive"]) for one in others}
    drives = [key for one in rows if (key := (one["fold"], one["drive"])) in common]
    a, b = _sums(rows, drives), _sums(others, drives)
    gap: Interval = Resamples.of(len(drives)).interval(difference(a, b))
    low, high = (f"{100 * one:+.2f}".replace("-", "−") for one in (gap.low, gap.high))
    return f"{100 * a.value:.2f}, {100 * b.value:.2f} % ({low} … {high} points)"


_HELD_OUT = {
    "download by hour (`tod`) against everything": ("held out in tod", "held out in copy"),
    "`budget`, a quarter of the bytes, against everything": (
        "held out in budget 1/4",
        "held out in copy",
    ),
}


_FLEET_ARMS = {"A": "Γ(distance)", "B": "`recall`"}


def fleet(
    tables: Path, study: str = "fleet", arms: Mapping[str, str] = _FLEET_ARMS
) -> Iterator[str]:
    """[G16]'s claims against ours: one agent and four groups, downloads for an hour."""
    sessions, summary = (read(tables / study / f"{name}.csv") for name in ("sessions", "summary"))
    of = {
        (arm, name): [
            one
            for one in summary
            if (one["arm"], one["experiment"], one["map"]) == (arm, "7", name)
            and one["fold"] != "all"
        ]
        for arm in arms
        for name in ("single", "4 groups")
    }
    yield f"| [G16] | paper | {' | '.join(arms.values())} |"
    yield f"| --- | --- |{' --- |' * len(arms)}"
    for what, column, paper in (
        ("four groups and merges ÷ one agent, time", "counted_s", "29.4 %"),
        ("the same, nodes", "nodes", "67.6 %"),
    ):
        total = {key: sum(float(one[column]) for one in some) for key, some in of.items()}
        shares = (100 * total[arm, "4 groups"] / total[arm, "single"] for arm in arms)
        yield f"| {what} | {paper} | {' | '.join(f'{one:.1f} %' for one in shares)} |"
    maps = {"route missed, merged against one agent": ("7", "4 groups", "single", "22.0, 32.0 %")}
    pairs = {what: ("9", *names, "slightly worse") for what, names in _HELD_OUT.items()}
    for what, (experiment, first, second, paper) in {**maps, **pairs}.items():
        cells = (
            _points(*(sessions_of(sessions, arm, experiment, name) for name in (first, second)))
            for arm in arms
        )
        yield f"| {what} | {paper} | {' | '.join(cells)} |"


def fleet_as_published(tables: Path) -> Iterator[str]:
    """The same with the papers' rules and a front-end as weak as theirs."""
    yield from fleet(tables, "fleet-as-published", {"S": "Γ(path), as published"})


def _peers_of(tables: Path, *scenes: str) -> dict[tuple[str, str], list[Row]]:
    """The rows of some scenes by scene and system, in the order of the table."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in read(tables / "peers/peers.csv"):
        if row["scene"] in scenes:
            # The page says once what the pipeline consists of.
            system = row["system"].replace(", VLAD and PnP", "")
            found.setdefault((row["scene"], system), []).append(row)
    return found


def _range(rows: Iterable[Row], name: str, digits: int) -> str:
    """The least and the greatest of a column's numbers, as they are shown."""
    known = sorted(float(row[name]) for row in rows if row[name])
    ends = dict.fromkeys(f"{one:.{digits}f}" for one in (known[0], known[-1]))
    return "–".join(ends)


# Scenes of the town, and how many drives their maps hold.
_OF_TOWN = {"village": "5", "village, two drives": "2"}


def peers(tables: Path) -> Iterator[str]:
    """The town: what each system localises of each drive, and what it costs."""
    found = _peers_of(tables, *_OF_TOWN)
    drives = [row["drive"] for row in next(iter(found.values()))]
    yield (
        f"| localised, % | mapped | {' | '.join(drives)} | false | gaps, % | error, cm "
        "| CPU, ms | MB |"
    )
    yield f"| --- |{' --- |' * (len(drives) + 6)}"
    for (scene, system), rows in found.items():
        shares = (f"{100 * int(row['localised']) / int(row['frames']):.0f}" for row in rows)
        false, fixes = (sum(int(row[name]) for row in rows) for name in ("false", "localised"))
        cells = [
            _OF_TOWN[scene],
            *shares,
            f"{false} of {fixes}",
            f"{max(100 * float(row['gap_share']) for row in rows):.0f}",
            _range(rows, "median_cm", 1),
            _range(rows, "cpu_ms", 0),
            f"{float(rows[0]['map_mb']):.0f}",
        ]
        yield f"| {system} | {' | '.join(cells)} |"


_CLIPS = ("KITTI 06", "EuRoC V1_01")


def peers_on_clips(tables: Path) -> Iterator[str]:
    """The same on the real clips."""
    found = _peers_of(tables, *_CLIPS)
    heads = (f"{clip} | false | error, cm | CPU, ms | MB" for clip in _CLIPS)
    yield f"| | {' | '.join(heads)} |"
    yield f"| --- |{' --- |' * 5 * len(_CLIPS)}"
    for system in dict.fromkeys(name for _, name in found):
        cells = []
        for clip in _CLIPS:
            (row,) = found[clip, system]
            cells += [
                f"{row['localised']} of {row['frames']}",
                row["false"],
                _range([row], "median_cm", 1),
                _range([row], "cpu_ms", 0),
                f"{float(row['map_mb']):.1f}",
            ]
        yield f"| {system} | {' | '.join(cells)} |"


@dataclass(frozen=True, slots=True)
class Block:
    """A part of a page: its study, and what draws it from the kept tables."""

    study: str
    draw: Callable[[Path], Iterator[str]]


BLOCKS: Mapping[str, Block] = {
    "real-images": Block("real-images", real_images),
    "real-images-in-short": Block("real-images", real_images_in_short),
    "robot-needs": Block("robot-needs", robot_needs),
    "bench": Block("bench", bench),
    "centre": Block("centre", centre),
    "eyes": Block("eyes", eyes),
    "kills": Block("kills", kills),
    "power-cuts": Block("power-cuts", power_cuts),
    "mutations": Block("mutations", mutations),
    "hand-ins": Block("hand-ins", hand_ins),
    "faults": Block("faults", faults),
    "faults-by-kind": Block("faults", faults_by_kind),
    "scale": Block("scale", scale),
    "scale-in-short": Block("scale", scale_in_short),
    "ranking": Block("ranking", ranking),
    "starved": Block("starved", starved),
    "conditions": Block("conditions", conditions),
    "kinds": Block("robot-needs", kinds),
    "year": Block("year", year),
    "month": Block("month", month),
    "budgets": Block("budgets", lambda tables: in_short(tables / "budgets/cells.csv")),
    "fleet": Block("fleet", fleet),
    "fleet-as-published": Block("fleet-as-published", fleet_as_published),
    "ranking-wet": Block("ranking-wet", ranking_wet),
    "ranking-keble": Block("ranking-keble", ranking_keble),
    "peers": Block("peers", peers),
    "peers-on-clips": Block("peers", peers_on_clips),
}


def drawn_block(name: str, tables: Path) -> str:
    """The text of a block, with what it says of its version."""
    block = BLOCKS.get(name)
    if block is None:
        raise InputError(f"no block {name!r} is drawn; those are {', '.join(BLOCKS)}")
    known = read_manifest(tables / block.study)
    if known is None:
        return f"*Not measured yet: `engram lab evaluate all --only {block.study}`.*\n"
    lines = list(block.draw(tables))
    if not known.is_current:
        world = f", world {known.world}" if STUDIES[block.study].town else ""
        lines += ["", f"*Of method version {known.method}{world}: older than this program.*"]
    return "\n".join(lines) + "\n"


def redrawn(text: str, tables: Path) -> str:
    """A page with its blocks as the tables have them."""
    return _BLOCK.sub(
        lambda found: found[1] + drawn_block(found[2], tables) + found[3],
        text,
    )


def pages(root: Path) -> dict[Path, list[str]]:
    """The pages below a checkout that have blocks, with their names."""
    texts = (root / "README.md", *sorted((root / "docs").glob("*.md")))
    reports = sorted((root / "lab/reports").glob("*.md"))
    found = {
        path: [one[2] for one in _BLOCK.finditer(path.read_text(encoding="utf-8"))]
        for path in (*texts, *reports)
    }
    return {path: names for path, names in found.items() if names}


def by_hand(root: Path) -> dict[Path, list[str]]:
    """The studies whose figures a page of README and docs has by hand."""
    found = {}
    for path in (root / "README.md", *sorted((root / "docs").glob("*.md"))):
        marked = _BY_HAND.findall(path.read_text(encoding="utf-8"))
        if marked:
            found[path] = [name.strip() for one in marked for name in one.split(",")]
    return found


def draw(root: Path) -> None:
    """Writes the blocks and the pictures of a checkout again from its tables."""
    tables = root / TABLES
    for path in pages(root):
        before = path.read_text(encoding="utf-8")
        after = redrawn(before, tables)
        if after != before:
            path.write_text(after, encoding="utf-8")
    for name, picture in pictures(tables).items():
        target = root / PICTURES / f"{name}.png"
        if source_of(target) != picture.source:
            picture.draw().savefig(target, dpi=110, metadata={_SOURCE: picture.source})


def source_of(picture: Path) -> str:
    """Digest of what a picture was drawn from; empty where it does not say, or is not there."""
    if not picture.exists():
        return ""
    said = re.search(rb"tEXt" + _SOURCE.encode() + rb"\0([0-9a-f]{16})", picture.read_bytes())
    return "" if said is None else said[1].decode()


def keep(results: Path, root: Path) -> list[str]:
    """Takes the tables of all studies that are done into the repository; their names."""
    taken = []
    for name, study in STUDIES.items():
        if State.of(name, results) is not State.DONE:
            continue
        target = root / TABLES / name
        target.mkdir(parents=True, exist_ok=True)
        for kept in (*study.tables, MANIFEST):
            shutil.copyfile(results / name / kept, target / kept)
        taken.append(name)
    return taken


def outdated(root: Path) -> Iterator[str]:
    """What of the pages is by hand, or of an older method, world or command, for people."""
    tables = root / TABLES
    for path, studies in by_hand(root).items():
        for study in studies:
            yield f"{path.relative_to(root)}: the figures of {study} are copied by hand"
    for path, names in pages(root).items():
        for name in names:
            known = read_manifest(tables / BLOCKS[name].study)
            if known is None:
                yield f"{path.relative_to(root)}: {name} was not measured"
            elif not known.is_current:
                where = path.relative_to(root)
                yield f"{where}: {name} is of method {known.method}, world {known.world}"


def main() -> None:
    """Keeps, draws, or says what is too old to be released."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("keep", "draw", "release"))
    parser.add_argument("results", type=Path, nargs="?", default=Path("results"))
    parser.add_argument("--root", type=Path, default=Path())
    asked = parser.parse_args()
    if asked.what == "keep":
        print("\n".join(keep(asked.results, asked.root)) or "no study is done there")
    if asked.what != "release":
        draw(asked.root)
        return
    if old := list(outdated(asked.root)):
        sys.exit("\n".join([*old, "run engram lab evaluate all, then pages keep"]))


if __name__ == "__main__":
    main()
