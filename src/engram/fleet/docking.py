"""Robots hand in their maps to the centre, one after another."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from engram.drive import Settings
from engram.drive.interruption import deferred_interrupt
from engram.errors import InputError
from engram.fleet.gate import Gate
from engram.fleet.handed_in import HandedIn
from engram.fleet.merging import Progress, merge_map, silent
from engram.fleet.pictures import picture_before_and_after
from engram.fleet.replay import MergeOptions
from engram.fleet.report import MergeReport
from engram.store import MapStore, WritableMapStore


def merge_maps(
    centre: Path,
    robots: Sequence[Path],
    settings: Settings,
    options: MergeOptions,
    *,
    dry_run: bool = False,
    require_better: Sequence[Path] = (),
    picture: Path | None = None,
    progress: Progress = silent,
) -> list[MergeReport]:
    """Merges robots' maps into a centre, in the order given; the centre is made if there is none.

    Each robot's map is one merge: one revision, all or nothing. What was handed in before changes
    nothing, so an interrupted command is simply given again.

    Args:
        centre: NAME.engram.
        robots: maps handed in.
        settings: the resolved configuration, kept with the revision.
        options: policy and budget.
        dry_run: merge into a copy of the centre, which is thrown away.
        require_better: held-out drives that must not localise worse in the result.
        picture: an image file for the centre before and after, from above.
        progress: shows how it goes.

    Returns:
        One report for each map, up to the one in which the command was interrupted.

    Raises:
        InputError: the centre itself is handed in.
        IncompatibleError: a map does not fit the centre.
        RefusedError: held-out drives localise worse in the result.
        MapError: a map cannot be read or written. Merges before the failing one stand.
    """
    for robot in robots:
        if not robot.exists():
            MapStore.open(robot).close()  # raises, before anything is made
        if centre.exists() and robot.samefile(centre):
            raise InputError(f"{robot} is the centre itself; hand in other maps")
    with _centre(centre, dry_run) as place:
        reports: list[MergeReport] = []
        with WritableMapStore.opened_or_created(place) as store:
            before = store.revision
            gate = Gate(require_better, settings) if require_better else None
            if gate is not None:
                gate.look_at(store)
        for robot in robots:
            started = time.perf_counter()
            report = _merge_one(place, robot, settings, options, progress, gate)
            report.dry_run = dry_run
            report.seconds = time.perf_counter() - started
            reports.append(report)
            if report.interrupted:
                break
        if picture is not None:
            picture_before_and_after(place, before, picture)
    return reports


def _merge_one(
    place: Path,
    robot: Path,
    settings: Settings,
    options: MergeOptions,
    progress: Progress,
    gate: Gate | None,
) -> MergeReport:
    """One merge in a freshly opened centre, so that it does not matter what came before it."""
    with (
        MapStore.open_for_writing(place) as store,
        HandedIn(MapStore.open(robot), str(robot)) as handed_in,
        deferred_interrupt() as raise_if_asked,
    ):
        resolved = settings.for_descriptor(handed_in.store.descriptor())
        try:
            return merge_map(
                store, handed_in, resolved, options, _interruptible(progress, raise_if_asked), gate
            )
        except KeyboardInterrupt:
            report = MergeReport(str(robot), handed_in.content_hash, handed_in.robots)
            report.interrupted = True
            report.content_hash = store.content_hash()
            return report


def _interruptible(progress: Progress, raise_if_asked: Callable[[], None]) -> Progress:
    """Ctrl-C is heard between two nodes."""

    @contextmanager
    def shown(what: str, total: int) -> Iterator[Callable[[str], None]]:
        with progress(what, total) as advance:

            def advance_or_stop(word: str) -> None:
                advance(word)
                raise_if_asked()

            yield advance_or_stop

    return shown


@contextmanager
def _centre(centre: Path, dry_run: bool) -> Iterator[Path]:
    """Where the merge goes: the centre, or a copy of it that is thrown away."""
    if not dry_run:
        yield centre
        return
    with tempfile.TemporaryDirectory(prefix="engram-dry-run-") as folder:
        copy = Path(folder) / centre.name
        if centre.exists():
            MapStore.copy(centre, copy)
        yield copy
