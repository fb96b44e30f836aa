"""Merging several robots' maps into the fleet map, one after another."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from engram.errors import InputError
from engram.files import draft_folder
from engram.fleet.merge.gate import Gate
from engram.fleet.merge.geometry import GeometryGate
from engram.fleet.merge.pictures import picture_before_and_after
from engram.fleet.merge.report import MergeReport
from engram.fleet.merge.settings import MergeOptions
from engram.fleet.merge.steps import Gates, merge_one
from engram.maps import Map, copy_map, publish_map
from engram.monitor import QUIET, Monitor, interruptible
from engram.robot import RobotOptions, Settings
from engram.viewing import check_picture


def merge(
    centre: Path,
    robots: Sequence[Path],
    options: MergeOptions | None = None,
    monitor: Monitor = QUIET,
    *,
    settings: Settings | None = None,
    dry_run: bool = False,
    require_better: Sequence[Path] = (),
    localising: RobotOptions | None = None,
    picture: Path | None = None,
    geometry: GeometryGate | None = None,
) -> list[MergeReport]:
    """Merges robots' maps into the fleet map, in the order given; creates it if missing.

    Each robot's map is one merge: one revision, all or nothing. Merging again changes nothing, so
    an interrupted command is run again. Ctrl-C takes effect after the current node or
    held-out frame, and undoes the current merge.

    Args:
        centre: the fleet's map, NAME.engram.
        robots: the maps to merge.
        options: policy and budget.
        monitor: receives progress, and each report as soon as its map is merged.
        settings: the resolved configuration, kept with the revision; None for the defaults.
        dry_run: merge into a copy of the fleet map and discard it.
        require_better: held-out drives that must not localise worse in the result.
        localising: policy and budget of these drives; None for the defaults.
        picture: an image file for a plan view of the fleet map before and after.
        geometry: looks for wrong edges in each result; None for no look.

    Returns:
        One report for each map, up to the one in which the command was interrupted.

    Raises:
        InputError: the fleet map itself is among `robots`, a held-out path is not a drive, or the
            picture cannot be written there. Nothing was merged.
        ConfigError: a drive is not held out. Nothing was merged.
        IncompatibleError: a map does not fit the fleet map.
        RefusedError: held-out drives localise worse in the result, or it has new wrong edges.
        MapError: a map cannot be read or written. If a map cannot be opened or its records are
            damaged, nothing was merged; otherwise earlier merges are kept.
        KeyboardInterrupt: Ctrl-C came before the first merge or after the last one, so there was
            none to undo.
    """
    options, settings = options or MergeOptions(), settings or Settings()
    if picture is not None:
        check_picture(picture)
    gate = Gate(require_better, settings, localising) if require_better else None
    gates = Gates(gate, geometry)
    _check_given(centre, robots, gate)
    reports: list[MergeReport] = []
    with _place(centre, dry_run=dry_run) as drafted:
        place = drafted
        with Map.open(place) as store:
            before = store.revision
        # One for all robots, so that a Ctrl-C at the end of a merge is not lost.
        with interruptible(monitor) as watched:
            gates.look_at(place, watched)
            for robot in robots:
                reports.append(_merged(place, robot, settings, options, gates, watched))
                if dry_run:
                    reports[-1].dry_run, reports[-1].revision = True, None
                if not (reports[-1].interrupted or dry_run or place == centre):
                    publish_map(place, centre)
                    place = centre
                watched.hear(reports[-1])
                if reports[-1].interrupted:
                    break
            else:
                watched.check()
        if picture is not None:
            picture_before_and_after(place, before, picture)
    return reports


def _check_given(centre: Path, robots: Sequence[Path], gate: Gate | None) -> None:
    """Checks all arguments before anything is made or changed."""
    for robot in robots:
        with Map.open(robot) as store:
            if centre.exists() and robot.samefile(centre):
                raise InputError(f"{robot} is the fleet map itself; name other maps to merge")
            sessions = store.load().sessions
        if gate is not None:
            gate.check_held_out(sessions, robot)
    if gate is not None and centre.exists():
        with Map.open(centre) as store:
            gate.check_held_out(store.sessions.values(), centre)


def _merged(
    place: Path,
    path: Path,
    settings: Settings,
    options: MergeOptions,
    gates: Gates,
    monitor: Monitor,
) -> MergeReport:
    """One merge in a freshly opened map, so that the result does not depend on earlier ones."""
    started = time.perf_counter()
    with Map.open(path) as robot:
        try:
            monitor.check()
            with Map.open(place, writes=True) as store:
                settings = settings.for_descriptor(robot.descriptor)
                report = merge_one(store, robot, settings, options, gates, monitor)
            if report.revision is None:
                monitor.check()
        except KeyboardInterrupt:
            report = replace(MergeReport.of(robot), interrupted=True)
            with Map.open(place) as store:
                report.content_hash = store.content_hash()
    report.seconds = time.perf_counter() - started
    return report


@contextmanager
def _place(centre: Path, *, dry_run: bool) -> Iterator[Path]:
    """The fleet map, a copy of it for a dry run, or the draft of a new one."""
    if centre.exists() and not dry_run:
        yield centre
    elif dry_run:
        with tempfile.TemporaryDirectory(prefix="engram-dry-run-") as folder:
            copy = Path(folder) / centre.name
            if centre.exists():
                copy_map(centre, copy)
            else:
                Map.create(copy).close()
            yield copy
    else:
        with draft_folder(centre) as folder:
            draft = folder / centre.name
            Map.create(draft).close()
            yield draft
