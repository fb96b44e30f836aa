"""What studies share: drives in folds, options, tasks; tables, curves and a page in Markdown."""

from __future__ import annotations

import csv
import math
import multiprocessing
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from engram import __version__
from engram.cli.settings import AllSettings
from engram.config import config_hash, to_dict
from engram.errors import ConfigError, InputError, MapLockedError, WorkerError, storage_full
from engram.files import WriterLock, current_holder
from engram.frontend.frame import DescriptorKind
from engram.frontend.matching import matcher_hash
from engram.localiser.relocalisation import check_relocaliser
from engram.localiser.settings import METHOD_VERSION
from engram.measures import Drive, Estimator, failure_sums
from engram.monitor import Monitor, write_whole
from engram.processes import end_with_parent, one_blas_thread
from engram.robot.settings import Settings
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
from engram_lab.studies.configurations import BY_TRUTH
from engram_lab.studies.drives import (
    DriveSet,
    EvaluatedDrive,
    Fold,
    check_only,
    chosen_folds,
    split,
)


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turns the file system's errors, in what writes below a folder, into Engram's."""
    try:
        yield
    except OSError as error:
        where = error.filename or folder
        if full := storage_full(error, where):
            raise full from error
        raise InputError(f"{where}: cannot be written: {error.strerror or error}") from error


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Lets no other run work in a folder meanwhile: they would take each other's drafts away."""
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
    """The folder of a report, before minutes go into what could not be kept."""
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


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """One step of an evaluation: it leaves what it makes on disk, where it is found again.

    Attributes:
        needs: names of the tasks that must be done before it.
        alone: whether it is timed, and has the machine for itself: such tasks are run in this
            process after all others, in their order.
    """

    name: str
    work: Callable[[], object]
    needs: tuple[str, ...] = ()
    word: str = ""
    alone: bool = False


def run_tasks(tasks: Sequence[Task], workers: int, monitor: Monitor) -> None:
    """Runs tasks in their order, side by side where they do not need each other."""
    if workers < 1:
        raise ConfigError(f"workers is {workers}, must be >= 1")
    beside, timed = ([one for one in tasks if one.alone is alone] for alone in (False, True))
    with _executor(workers) as executor:
        waiting, done = list(beside), set[str]()
        running: dict[Future[object], Task] = {}
        try:
            while waiting or running:
                # With one worker a task is done as soon as it is submitted: none overtakes.
                ready = next((one for one in waiting if done.issuperset(one.needs)), None)
                if ready is not None and len(running) < workers:
                    waiting.remove(ready)
                    running[executor.submit(ready.work)] = ready
                assert running, "a task needs one that does not come before it"
                if ready is None or len(running) == workers:
                    finished, _ = wait(running, return_when=FIRST_COMPLETED)
                    for future in finished:
                        task = running.pop(future)
                        future.result()
                        done.add(task.name)
                        monitor.advance(task.word)
        except BrokenProcessPool as error:
            raise WorkerError(
                f"a worker of {workers} died (out of memory?); give the same command again, "
                "perhaps with fewer --workers; what was done is kept"
            ) from error
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise
    for task in timed:
        task.work()
        monitor.advance(task.word)


class _Here(Executor):
    """Runs everything at once, in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@contextmanager
def _executor(workers: int) -> Iterator[Executor]:
    if workers == 1:
        yield _Here()
        return
    # Started afresh: a forked child would share the parent's threads half way through.
    context = multiprocessing.get_context("spawn")
    with one_blas_thread(), ProcessPoolExecutor(workers, context, _begin_worker) as pool:
        yield pool


def _begin_worker() -> None:
    end_with_parent()
    cv2.setNumThreads(1)  # the tasks run side by side


# Raise it whenever a study runs otherwise under equal settings, or keeps more of what it ran:
# studies of before are not gone on with.
_STUDY_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyOptions:
    """Options of every study.

    Attributes:
        relocaliser: one of `relocaliser_names()`; `BY_TRUTH`, of ranking studies, which finds
            all that can be found; None for none.
        only_folds: numbers of the folds that are run; empty for all. What is run of the others
            later joins it.
    """

    folds: int = 5
    seed: int = 0
    relocaliser: str | None = None
    only_folds: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.relocaliser not in (None, BY_TRUTH):
            check_relocaliser(self.relocaliser)
        check_only(self.only_folds, self.folds)


Options = TypeVar("Options", bound=StudyOptions)


@dataclass(frozen=True, slots=True)
class StudyPlan(Generic[Options]):
    """All that a worker needs."""

    drives: DriveSet
    settings: Settings
    options: Options
    work: Path
    tables: AllSettings = field(default_factory=AllSettings)

    @property
    def folds(self) -> tuple[Fold, ...]:
        """The divisions of the drives."""
        return split(len(self.drives.drives), self.options.folds, self.options.seed)

    @property
    def run_folds(self) -> tuple[Fold, ...]:
        """Those that are run now."""
        return chosen_folds(self.folds, self.options.only_folds)

    def training(self, fold: Fold) -> list[EvaluatedDrive]:
        """In the order of time."""
        return [self.drives.drives[number] for number in fold.training]

    def held_out(self, fold: Fold) -> list[EvaluatedDrive]:
        """In the order of time."""
        return [self.drives.drives[number] for number in fold.held_out]

    def configuration(self) -> dict[str, Any]:
        """The resolved configuration, kept with the results."""
        return {
            "campaign": self.drives.name,
            "drives": [one.name for one in self.drives.drives],
            "drives_hash": self.drives.hash,
            "with_truth": self.drives.has_truth,
            "folds": [to_dict(one) for one in self.folds],
            "settings": to_dict(self.tables),
            "options": to_dict(self.options),
            "matcher": matcher_hash(self.settings.localiser.matcher),
            "machine": platform.machine(),
            "engram": __version__,
        }

    def begin(self) -> None:
        """Makes the folder, and notes there what it is for."""
        with writing(self.work):
            self.work.mkdir(parents=True, exist_ok=True)
            write_json(self.work / "configuration.json", self.configuration())

    def run(
        self,
        tasks: Sequence[Task],
        workers: int,
        monitor: Monitor,
        close: Callable[[], None],
    ) -> None:
        """Runs the tasks of a study, alone in its folder; `close` is called at the end."""
        try:
            with (
                writing(self.work),
                alone_in(self.work),
                monitor.stage(f"evaluate {self.drives.name}", len(tasks)) as part,
            ):
                run_tasks(tasks, workers, part)
        finally:
            close()


def all_tables(settings: Settings, descriptor: DescriptorKind) -> AllSettings:
    """The settings of a study for a kind of descriptor; those of robots alone leave the verbs'."""
    if not isinstance(settings, AllSettings):
        settings = AllSettings(
            **{one.name: getattr(settings, one.name) for one in fields(settings)}
        )
    return settings.for_descriptor(descriptor)


def study_folder(work: Path, name: str, depends: Sequence[Any], settings: Settings) -> Path:
    """A folder that depends on all that a study's maps and results depend on."""
    everything = (
        *depends,
        to_dict(settings),
        matcher_hash(settings.localiser.matcher),
        METHOD_VERSION,
        _STUDY_VERSION,
        __version__,
    )
    plain = "".join(c if c.isalnum() or c in "-_@" else "-" for c in name)
    return work / f"{plain}-{config_hash(everything)}"
