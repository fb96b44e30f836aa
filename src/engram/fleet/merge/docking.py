"""Robots hand in their maps to the centre, one after another."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from engram.errors import InputError
from engram.fleet.merge.centre import Centre
from engram.fleet.merge.checks import check_fits, check_readable
from engram.fleet.merge.gate import Gate
from engram.fleet.merge.handed_in import HandedIn
from engram.fleet.merge.merging import Progress, merge_map, silent
from engram.fleet.merge.pictures import picture_before_and_after
from engram.fleet.merge.replay import MergeOptions
from engram.fleet.merge.report import MergeReport
from engram.maps import FORMAT_VERSION, MapStore
from engram.maps.drafts import draft_folder
from engram.monitor import deferred_interrupt
from engram.robot import Settings
from engram.viewing import check_picture


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
    told: Callable[[MergeReport], None] = lambda _: None,
) -> list[MergeReport]:
    """Merges robots' maps into a centre, in the order given; the centre is made if there is none.

    Each robot's map is one merge: one revision, all or nothing. What was handed in before changes
    nothing, so an interrupted command is simply given again. Ctrl-C waits for the end of the node
    or of the held-out frame, and undoes the merge that it meets.

    Args:
        centre: NAME.engram.
        robots: maps handed in.
        settings: the resolved configuration, kept with the revision.
        options: policy and budget.
        dry_run: merge into a copy of the centre, which is thrown away.
        require_better: held-out drives that must not localise worse in the result.
        picture: an image file for the centre before and after, from above.
        progress: shows how it goes.
        told: is given each report as soon as its map is merged, whatever becomes of the next.

    Returns:
        One report for each map, up to the one in which the command was interrupted.

    Raises:
        InputError: the centre itself is handed in, a drive is none, or the picture cannot be
            drawn there. Nothing was merged.
        ConfigError: a drive is not held out. Nothing was merged.
        IncompatibleError: a map does not fit the centre.
        RefusedError: held-out drives localise worse in the result.
        MapError: a map cannot be read or written. Where a map cannot be opened or its records are
            damaged, nothing was merged; else merges before the failing one stand.
        KeyboardInterrupt: Ctrl-C met no merge that could be undone: it came before the first one,
            or when the last one was done.
    """
    if picture is not None:
        check_picture(picture)
    gate = Gate(require_better, settings) if require_better else None
    _check_given(centre, robots, gate)
    reports: list[MergeReport] = []
    with _place(centre, dry_run=dry_run) as place:
        with deferred_interrupt() as raise_if_asked:
            docking = _Docking(settings, options, progress, gate, raise_if_asked)
            before = docking.look_at(place.path)
            for robot in robots:
                started = time.perf_counter()
                report = docking.merge(place.path, robot)
                report.dry_run = dry_run
                report.seconds = time.perf_counter() - started
                if not report.interrupted:
                    place.settle()
                reports.append(report)
                told(report)
                if report.interrupted:
                    break
            else:
                raise_if_asked()
        if picture is not None:
            picture_before_and_after(place.path, before, picture)
    return reports


def _check_given(centre: Path, robots: Sequence[Path], gate: Gate | None) -> None:
    """Looks at all that was given before anything is made or changed."""
    for robot in robots:
        with MapStore.open(robot) as store:
            if centre.exists() and robot.samefile(centre):
                raise InputError(f"{robot} is the centre itself; hand in other maps")
            sessions = store.load().sessions
        if gate is not None:
            gate.check_held_out(sessions, robot)
    if gate is not None and centre.exists():
        with MapStore.open(centre) as store:
            gate.check_held_out(store.sessions(), centre)


@dataclass(frozen=True, slots=True)
class _Docking:
    """How each robot's map is merged.

    Attributes:
        settings, options, progress: see `merge_maps`.
        gate: that each result must pass; None for none.
        raise_if_asked: raises KeyboardInterrupt after Ctrl-C. One for all robots: what is pressed
            when a merge is just done must not be forgotten with it.
    """

    settings: Settings
    options: MergeOptions
    progress: Progress
    gate: Gate | None
    raise_if_asked: Callable[[], None]

    def look_at(self, place: Path) -> int:
        """The centre before the first merge, and how held-out drives fare there.

        Returns:
            Its revision.
        """
        with MapStore.open(place) as store:
            if self.gate is not None:
                self.gate.look_at(store, self._hear)
            return store.revision

    def merge(self, place: Path, robot: Path) -> MergeReport:
        """One merge in a freshly opened centre, so that it does not matter what came before it."""
        with HandedIn(MapStore.open(robot), str(robot)) as handed_in:
            try:
                self.raise_if_asked()
                report = self._merged(place, handed_in)
                if report.revision is None:
                    self.raise_if_asked()
            except KeyboardInterrupt:
                report = MergeReport(str(robot), handed_in.content_hash, handed_in.robots)
                report.interrupted = True
                with MapStore.open(place) as store:
                    report.content_hash = store.content_hash()
            return report

    def _merged(self, place: Path, robot: HandedIn) -> MergeReport:
        _check_before_raising(place, robot)
        with MapStore.open_for_writing(place) as store:
            return merge_map(
                store,
                robot,
                self.settings.for_descriptor(robot.store.descriptor()),
                self.options,
                _interruptible(self.progress, self.raise_if_asked),
                None if self.gate is None else partial(self.gate, advance=self._hear),
                self.raise_if_asked,
            )

    def _hear(self, _: str) -> None:
        """Ctrl-C is heard between two frames of a held-out drive."""
        self.raise_if_asked()


def _check_before_raising(place: Path, robot: HandedIn) -> None:
    """A centre of an older format becomes one of the newest when it is opened for writing.

    A map that is refused shall not do even that.
    """
    with MapStore.open(place) as store:
        if store.format_version < FORMAT_VERSION:
            check_fits(Centre(store), robot)
            check_readable(robot, robot.contents.nodes)


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


@dataclass(slots=True)
class _Place:
    """Where merges go.

    Attributes:
        path: the map file.
        target: the name it gets with its first merge; None where it has it, or never gets one.
    """

    path: Path
    target: Path | None = None

    def settle(self) -> None:
        """A merge went well: a centre that is new appears under its name."""
        if self.target is not None:
            MapStore.publish(self.path, self.target)
            self.path, self.target = self.target, None


@contextmanager
def _place(centre: Path, *, dry_run: bool) -> Iterator[_Place]:
    """The centre; a copy of it that is thrown away; or the draft of one that is new."""
    if centre.exists() and not dry_run:
        yield _Place(centre)
    elif dry_run:
        with tempfile.TemporaryDirectory(prefix="engram-dry-run-") as folder:
            copy = Path(folder) / centre.name
            if centre.exists():
                MapStore.copy(centre, copy)
            else:
                MapStore.create(copy).close()
            yield _Place(copy)
    else:
        with draft_folder(centre) as folder:
            draft = folder / centre.name
            MapStore.create(draft).close()
            yield _Place(draft, centre)
