"""The output folder of a study: tidy tables as CSV, curves, and a page in Markdown.

A row is a dictionary, and a table a list of rows. The page's renderer looks at names of columns
alone: shares are printed in per cent, and a column with ``_low`` and ``_high`` beside it gets its
interval.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError, MapLockedError, storage_full
from engram.files import WriterLock, current_holder
from engram.measures import Drive, Estimator, failure_sums
from engram.monitor import write_whole
from engram_lab.charts import Line
from engram_lab.intervals import (
    Interval,
    Resamples,
    SessionSums,
    Statistic,
    difference,
    not_localised_sums,
    product,
)
from engram_lab.studies.building import write_json


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turns the file system's errors, in what writes below a folder, into Engram's.

    Raises:
        StorageFullError: no space is left.
        InputError: the folder or a file in it cannot be written.
    """
    try:
        yield
    except OSError as error:
        where = error.filename or folder
        if full := storage_full(error, where):
            raise full from error
        raise InputError(f"{where}: cannot be written: {error.strerror or error}") from error


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Lets no other run work in a folder meanwhile: they would take each other's drafts away.

    Raises:
        MapLockedError: another run works there.
        MapError: the folder cannot be locked.
    """
    locked = folder / "run"
    try:
        lock = WriterLock(locked)
    except MapLockedError as error:
        raise MapLockedError(
            f"{folder}: {current_holder(locked) or 'another process'} evaluates there; wait until "
            "it is done, give another --work, or look at what is done with --report-only"
        ) from error
    try:
        yield
    finally:
        lock.release()


Row: TypeAlias = dict[str, Any]
_SHARES = ("share_", "p_gt_", "excess_", "minus_", "expected_missed", "union_", "united_share")


def make_folder(out: Path) -> None:
    """The folder of a report, before minutes go into what could not be kept.

    Raises:
        InputError: it cannot be made.
        StorageFullError: no space is left.
    """
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)


def write_study(
    out: Path,
    tables: Mapping[str, Sequence[Row]],
    page: Iterable[str],
    configuration: Any,
    draw: Callable[[Path], list[Path]],
) -> list[Path]:
    """Tables, page, configuration and figures; files of an earlier report are replaced.

    The folder is there; see `make_folder`.

    Returns:
        The files written.

    Raises:
        InputError: the folder cannot be written.
        StorageFullError: no space is left.
        MissingExtraError: Matplotlib is not installed; all but the figures is written by then.
    """
    with writing(out):
        for name, rows in tables.items():
            write_csv(out / f"{name}.csv", rows)
        write_json(out / "configuration.json", configuration)
        with write_whole(out / "report.md") as draft:
            draft.write_text("\n".join(page) + "\n", encoding="utf-8")
        files = [*(f"{name}.csv" for name in tables), "configuration.json", "report.md"]
        return [out / name for name in files] + draw(out)


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Writes a table in one step; columns are the keys of all rows."""
    columns = dict.fromkeys(name for row in rows for name in row)
    with write_whole(path) as draft, draft.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(columns))
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})


def chosen(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """The rows that have these values."""
    return [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]


def table(
    rows: Sequence[Row], columns: Mapping[str, str] | None = None, beside: str = ""
) -> Iterator[str]:
    """Markdown lines of some columns, by name and heading; without, of all that are not empty.

    `beside` is a line below them that says what is in force.
    """
    if columns is None:
        names = dict.fromkeys(name for row in rows for name in row)
        full = (name for name in names if any(row.get(name) not in (None, "") for row in rows))
        columns = {name: name.replace("_", " ") for name in full if not name.endswith(_ENDS)}
    if rows:
        yield _line(columns.values())
        yield _line("---" for _ in columns)
        for row in rows:
            yield _line(cell(row, name) for name in columns)
        yield from ("", beside, "") if beside else ("",)


def plain_table(rows: Sequence[Row], columns: Mapping[str, str]) -> Iterator[str]:
    """Lines of some columns for a terminal, by name and heading."""
    cells = [[*columns.values()], *([cell(row, name) for name in columns] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for line in cells:
        yield "  ".join(map(str.ljust, line, widths)).rstrip()


def pivot(rows: Iterable[Row], index: str, across: str, value: str) -> list[Row]:
    """One row per value of `index`, one column per value of `across`, in order of appearance."""
    found: dict[Any, Row] = {}
    for row in rows:
        found.setdefault(row[index], {index: row[index]})[str(row[across])] = cell(row, value)
    return list(found.values())


_ENDS = ("_low", "_high")


def cell(row: Row, name: str) -> str:
    """A value as people read it, with its interval where there is one."""
    value = row.get(name)
    if value is None or value == "":
        return "–"
    if not isinstance(value, float):
        return str(value)
    scale, unit = (100.0, " %") if name.startswith(_SHARES) else (1.0, "")
    ends = [row.get(name + end) for end in _ENDS]
    text = _number(scale * value) + unit
    if None not in ends:
        text += " ({} … {})".format(*(_number(scale * end) for end in ends if end is not None))
    return text


def compared(
    what: str, a: SessionSums, b: SessionSums, resamples: Resamples, paper: str = ""
) -> Row:
    """Two shares of the same sessions, and their paired difference with its interval."""
    gap = resamples.interval(difference(a, b))
    shares: Row = {"what": what, "paper": paper, "share_a": a.value, "share_b": b.value}
    ends = {"minus_b_low": gap.low, "minus_b_high": gap.high}
    return {**shares, "minus_b": gap.estimate, **ends}


def rated(what: str, ratio: Statistic, resamples: Resamples, paper: str = "") -> Row:
    """A ratio of measures of the same sessions, with its interval."""
    found = resamples.interval(ratio)
    ends = {"ratio_low": found.low, "ratio_high": found.high}
    return {"what": what, "paper": paper, "ratio": found.estimate, **ends}


COMPARED = {
    "what": "what",
    "paper": "paper",
    "share_a": "first",
    "share_b": "second",
    "minus_b": "difference",
    "ratio": "ratio",
}


def compared_drives(
    what: str, a: Sequence[Drive], b: Sequence[Drive], seed: int, paper: str = ""
) -> Row:
    """The route not localised on the same drives under two conditions."""
    sums = not_localised_sums(a), not_localised_sums(b)
    row = compared(what, *sums, Resamples.of(len(a), seed=seed), paper)
    return {**row, "drives": len(a)}


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _number(value: float) -> str:
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "∞"
    digits = 0 if abs(value) >= 1000 else 2
    return f"{value:.{digits}f}".replace("-", "\N{MINUS SIGN}")


# Where failure curves are drawn.
CURVE_AT_M = np.arange(0.0, 50.5, 0.5)


def failure_line(
    label: str,
    drives: Sequence[Drive],
    resamples: Resamples,
    estimator: Estimator = Estimator.ROUTE,
    *,
    scaled: bool = False,
) -> Line:
    """P(X ≥ x) in per cent.

    Args:
        label: of the line.
        drives: one per session.
        resamples: draws of sessions.
        estimator: of P.
        scaled: times the share of the route that is not localised (method §8).
    """
    parts = [failure_sums(one, CURVE_AT_M, estimator) for one in drives]
    below = np.array([part[1] for part in parts])
    missed = not_localised_sums(drives)
    sums = [
        SessionSums(np.array([part[0][k] for part in parts]), below) for k in range(len(CURVE_AT_M))
    ]
    bands = [resamples.interval(product(one, missed) if scaled else one) for one in sums]
    return _banded(label, CURVE_AT_M, bands, marks=False)


def row_line(label: str, rows: Sequence[Row], x: Sequence[float], column: str) -> Line:
    """A column of a table in per cent, with the band that the table has for it."""
    bands = [
        Interval(*(row.get(column + end, np.nan) for end in ("", "_low", "_high"))) for row in rows
    ]
    return _banded(label, np.array(x, np.float64), bands)


def _banded(
    label: str, x: NDArray[np.float64], bands: Iterable[Interval], *, marks: bool = True
) -> Line:
    y, low, high = 100 * np.array([(one.estimate, one.low, one.high) for one in bands]).T
    return Line(label, x, y, low, high, marks=marks)
