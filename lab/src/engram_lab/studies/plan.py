"""What both studies are: drives in folds, settings, options, tasks, and an output folder."""

from __future__ import annotations

import multiprocessing
import platform
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Generic, TypeVar

import cv2

from engram import __version__
from engram.cli.settings import AllSettings
from engram.config import config_hash, to_dict
from engram.errors import ConfigError, WorkerError
from engram.frontend.frame import DescriptorKind
from engram.frontend.matching import matcher_hash
from engram.localiser.relocalisation import RELOCALISERS
from engram.localiser.settings import METHOD_VERSION
from engram.monitor import Monitor
from engram.processes import end_with_parent
from engram.robot.settings import Settings
from engram_lab.studies.building import write_json
from engram_lab.studies.drives import DriveSet, EvaluatedDrive, Fold, check_only, chosen, split
from engram_lab.studies.pages import alone_in, writing


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """One step of an evaluation: it leaves what it makes on disk, where it is found again.

    Attributes:
        name: unique among the tasks of a run.
        work: picklable; what it returns is not looked at.
        needs: names of the tasks that must be done before it.
        word: for the progress bar.
        alone: whether it is timed, and has the machine for itself: such tasks are run in this
            process after all others, in their order.
    """

    name: str
    work: Callable[[], object]
    needs: tuple[str, ...] = ()
    word: str = ""
    alone: bool = False


def run_tasks(tasks: Sequence[Task], workers: int, monitor: Monitor) -> None:
    """Runs tasks in their order, side by side where they do not need each other.

    Args:
        tasks: each behind those that it needs.
        workers: processes; with one everything runs in this process.
        monitor: hears of each task that is done.

    Raises:
        ConfigError: there is no worker.
        WorkerError: a worker died.
        EngramError: whatever a task raised; the tasks that were done stay done.
    """
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
    with ProcessPoolExecutor(workers, context, _begin_worker) as pool:
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
        folds: of the cross-validation.
        seed: of the shuffle of sessions and of the bootstrap.
        relocaliser: key of `RELOCALISERS`; None for none.
        only_folds: numbers of the folds that are run; empty for all. What is run of the others
            later joins it.
    """

    folds: int = 5
    seed: int = 0
    relocaliser: str | None = None
    only_folds: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.relocaliser is not None and self.relocaliser not in RELOCALISERS:
            raise ConfigError(
                f"relocaliser {self.relocaliser!r} is unknown; known: {', '.join(RELOCALISERS)}"
            )
        check_only(self.only_folds, self.folds)


Options = TypeVar("Options", bound=StudyOptions)


@dataclass(frozen=True, slots=True)
class StudyPlan(Generic[Options]):
    """All that a worker needs.

    Attributes:
        drives: what is evaluated.
        settings: the resolved configuration of its robots.
        options: what is run.
        work: folder of maps and results.
        tables: the same with the tables of the verbs.
    """

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
        return chosen(self.folds, self.options.only_folds)

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
