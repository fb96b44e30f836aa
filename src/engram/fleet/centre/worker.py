"""The loop of a worker: hand-ins, downloads, dreams, and the removal of what nothing needs.

Removes packs whose parts no hand-in and no download needs any more. Kept are the parts of hand-ins
that are under way or refused, of those that ended lately, of each robot's newest merged one, which
its next one continues, and of downloads. What was swept is requested again where it is needed
again: `wanted` lists it, as no robot counts as having sent it.

Keeps each map within its cap, with each sweep: what serves least is forgotten, and erased by hand.

Dreams, when nothing else is to do: given up for whatever a robot hands in or asks for. A dream runs
in a process of its own at low priority, which may be killed at any moment: what was tried is kept
next to the map, and the next one continues from there.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeAlias

from sqlalchemy import select

from engram.errors import EngramError, MapCorruptError, MapLockedError, StorageFullError
from engram.fleet.centre import downloads, dreams, handins, jobs
from engram.fleet.centre.database import first_row, note
from engram.fleet.centre.fleet import move_ref
from engram.fleet.centre.merge_job import JobMonitor, admit, merge_apart
from engram.fleet.centre.objects import written_ns
from engram.fleet.centre.problems import StoreError
from engram.fleet.centre.service import (
    DAY_NS,
    Centre,
    kept_since_ns,
    needed_manifests,
)
from engram.fleet.centre.tables import Artifact, Dream, HandIn, JobState, artifacts, packs
from engram.fleet.dream import DreamOptions, dream
from engram.fleet.forgetting import Retention, forget
from engram.fleet.transfers import PartHash, blobs_named, decode_manifest
from engram.maps.forgetting import NothingToForgetError
from engram.maps.map import Map
from engram.processes import end_with_parent
from engram.robot.settings import Settings

# Parts of manifests, by the manifest's hash.
_Marks: TypeAlias = dict[str, set[PartHash]]


def sweep_all(centre: Centre) -> None:
    """Sweeps every map that no other worker has; what hinders it is noted, and harms no hand-in."""
    for name in centre.map_names():
        with centre.lane(name) as is_ours:
            try:
                if is_ours:
                    sweep(centre, name)
                    keep_to_cap(centre, name)
            except EngramError as error:
                with centre.database.writing() as connection:
                    why = str(error)
                    note(connection, centre.now_ns(), "worker", "sweep-failed", name, error=why)


def keep_to_cap(centre: Centre, name: str) -> int:
    """Forgets the nodes of a map that are beyond its cap; how many that were.

    Only in the map's lane.
    """
    most_bytes = centre.policy(name).cap_bytes
    if most_bytes is None:
        return 0
    cap = Retention(down_to=(most_bytes, None))
    try:
        done = forget(centre.map_path(name), cap, author=jobs.WORKER, why="the map's cap")
    except NothingToForgetError:
        return 0
    made = centre.prepared(name)
    with centre.database.writing() as connection:
        detail = {"revision": done.revision, "nodes": done.nodes}
        note(connection, centre.now_ns(), jobs.WORKER, "cap", name, **detail)
        centre.copies.publish(connection, made)
    return done.nodes


def sweep(centre: Centre, name: str) -> int:
    """Removes the packs of one map that nothing needs, and empties those that little is needed of.

    Uploads and downloads may continue: what is needed is looked up again in the transaction that
    forgets packs, and whoever stores parts looks in his whether those he found are still there.
    What was forgotten is deleted by the next sweep, so that readers and backups that looked before
    still find it.

    Args:
        centre: the centre.
        name: of the map.

    Returns:
        Bytes of the packs that are forgotten.
    """
    _delete_forgotten(centre, name)
    limit_ns, store = kept_since_ns(centre), centre.packs(name)
    marks: _Marks = {}
    with centre.database.reading() as connection:
        manifests = needed_manifests(connection, name, limit_ns)
    _mark(centre, name, manifests, marks)
    with centre.database.writing() as connection:
        making = (artifacts.c.map == name, artifacts.c.state == JobState.ASKED)
        if first_row(connection, Artifact, *making) is not None:
            return 0  # its parts are found or stored now, and not yet named by a manifest
        manifests = needed_manifests(connection, name, limit_ns)
        _mark(centre, name, manifests, marks)
        needed = set[PartHash]().union(*(marks[manifest] for manifest in manifests))
        gone = store.little_needed(connection, needed, limit_ns)
        size = sum(store.forget(connection, pack, kept, centre.now_ns()) for pack, kept in gone)
        if gone:
            note(connection, centre.now_ns(), "worker", "sweep", name, packs=len(gone), bytes=size)
    return size


def _mark(centre: Centre, name: str, manifests: Mapping[str, str], marks: _Marks) -> None:
    """Adds the parts of manifests that are not marked yet, as far as they are there."""
    store = centre.packs(name)
    for key, place in manifests.items():
        if key in marks:
            continue
        manifest = decode_manifest(centre.objects.get(place))
        pages = dict(store.read(dict.fromkeys(manifest.hashes())))
        marks[key] = set(pages)
        stored = {
            table: tuple(page for page in listed if page in pages)
            for table, listed in manifest.pages.items()
        }
        with suppress(MapCorruptError):  # a stranger's page: its hand-in fails by itself
            for _, _, blobs in blobs_named(replace(manifest, pages=stored), pages.get):
                marks[key].update(blobs)


def _delete_forgotten(centre: Centre, name: str) -> None:
    """Deletes what no row names: packs forgotten by the sweep before, or what a kill left."""
    limit_ns = min(kept_since_ns(centre), centre.now_ns() - DAY_NS)
    keys = [key.rsplit("/", 1)[1] for key in centre.objects.keys(f"packs/{name}")]
    with centre.database.reading() as connection:
        known = set(connection.execute(select(packs.c.id).where(packs.c.map == name)).scalars())
    for pack in keys:
        if pack not in known and written_ns(pack) <= limit_ns:
            centre.objects.delete(f"packs/{name}/{pack}")
    if centre.policy(name).copies:
        centre.copies.clean(name, limit_ns)


_NICENESS = 10


def dream_a_while(
    centre: Centre,
    wait: Callable[[float], object],
    stopped: Callable[[], bool],
    scheduler: str | None = None,
) -> bool:
    """Dreams the first dream that is due, until there is something else to do.

    Args:
        centre: the centre.
        wait: see `work`.
        stopped: see `work`.
        scheduler: address of a Dask scheduler whose workers try; None to try here.

    Returns:
        Whether it dreamt.
    """
    dreams.ask_quietly(centre)
    due = dreams.due(centre)
    _clear_left(centre, due)
    for row in due:
        with centre.lane(row.map) as is_ours:
            if is_ours and not _is_needed(centre):
                _dream_apart(centre, row, wait, stopped, scheduler)
                return True
    return False


def _clear_left(centre: Centre, due: list[Dream]) -> None:
    """Removes what killed dreams left that will not be resumed: copies of all robots' maps."""
    names = {f"dream-{row.id}" for row in due}
    for folder in (centre.folder / "work").glob("dream-*"):
        if folder.name not in names:
            shutil.rmtree(folder, ignore_errors=True)


def _dream_apart(
    centre: Centre,
    row: Dream,
    wait: Callable[[float], object],
    stopped: Callable[[], bool],
    scheduler: str | None,
) -> None:
    context = multiprocessing.get_context("spawn")
    given = (centre.folder, *centre.addresses, row.id, scheduler)
    process = context.Process(target=_dream_here, args=given)
    process.start()
    gives_up = False
    try:
        while process.is_alive() and not gives_up:
            wait(centre.settings.poll_s)
            gives_up = stopped() or _is_needed(centre) or not dreams.is_due(centre, row)
    finally:
        process.kill()
        process.join()
    if process.exitcode and not gives_up:
        fact = f"its process ended with exit code {process.exitcode}"
        jobs.set_state(centre, row, JobState.FAILED, error=fact)


def _is_needed(centre: Centre) -> bool:
    """Whether robots wait for a worker."""
    return bool(jobs.pending(centre, HandIn) or jobs.pending(centre, Artifact))


def _dream_here(
    folder: Path, database: str | None, objects: str | None, key: str, scheduler: str | None
) -> None:
    """Main function of the process."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the worker ends it
    os.nice(_NICENESS)
    with Centre(folder, database, objects) as centre:
        dream_of(centre, jobs.get(centre, Dream, key), scheduler)


def dream_of(centre: Centre, row: Dream, scheduler: str | None = None) -> None:
    """Runs one dream to its end, and records the result in its row.

    A map that is being written to by hand, or a full disk, leaves the request pending.
    """
    policy = centre.policy(row.map)
    options = DreamOptions(scheduler=scheduler, merging=policy.merge)
    drives = [Path(drive) for drive in policy.gate]
    monitor = JobMonitor(partial(jobs.heartbeat, centre, row))
    path = centre.map_path(row.map)
    try:
        with _scratch(centre.folder / "work" / f"dream-{row.id}") as folder:
            robots = list(_maps_of_robots(centre, row.map, folder))
            report = dream(path, robots, drives, Settings(), options, monitor)
    except (MapLockedError, StorageFullError):
        return
    except KeyboardInterrupt:
        jobs.set_state(centre, row, JobState.CANCELLED, error="cancelled")
        return
    except EngramError as error:
        jobs.set_state(centre, row, JobState.FAILED, error=centre.words_of(error))
        return
    shown = report.to_dict() | {"centre": row.map}
    if report.added is None:
        revision = _made_before(path, row.since)
    else:
        revision, shown["added"]["out"] = report.added.revision, row.map
    made = centre.prepared(row.map)
    jobs.set_state(centre, row, JobState.DONE, made=made, revision=revision, report=shown)
    if policy.moves is not None and revision is not None:
        move_ref(centre, row.map, policy.moves, revision, "dream")


def _made_before(path: Path, since: int) -> int | None:
    """The revision that this dream made before its process died; else None."""
    with Map.open(path) as store:
        log = [entry for entry in store.log() if entry.message.startswith("dream: ")]
    return max((entry.number for entry in log if entry.number > since), default=None)


def _maps_of_robots(centre: Centre, name: str, folder: Path) -> Iterator[Path]:
    """Robots' maps as they were handed in, oldest first."""
    limits = centre.settings
    for number, row in enumerate(dreams.merged_handins(centre, name)):
        path, manifest = folder / f"{number:04}.engram", handins.manifest_of(centre, row)
        parts = dreams.parts_of(centre, row, manifest)
        admit(manifest, parts, path, limits.admission_bytes, limits.admission_s)
        yield path


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """An empty folder for the length of the block."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


_log = logging.getLogger(__name__)
# A full disk takes a person: until then the same job is not tried four times a second.
_AGAIN_S = 10.0
_HOUR_NS = 3_600_000_000_000


def work_off(centre: Centre, take: Callable[[Centre, HandIn], None] = merge_apart) -> int:
    """Does what there is to do; returns the number of settled jobs.

    Args:
        centre: the centre.
        take: merges a hand-in.

    Raises:
        EngramError: what hinders the centre; of each map, after all of them had their turn. Jobs
            wait.
    """
    settled, hindered = 0, list[EngramError]()
    handins.expire(centre)
    downloads.expire(centre)
    for name in dict.fromkeys(row.map for row in jobs.pending(centre, HandIn)):
        try:
            with centre.lane(name) as is_ours:
                for row in jobs.pending(centre, HandIn, name) if is_ours else ():
                    settled += _make_downloads(centre, hindered)
                    take(centre, row)
                    settled += 1
        except EngramError as error:  # the next map may have its disk and its drives
            hindered.append(error)
    settled += _make_downloads(centre, hindered)
    if hindered:
        raise hindered[0]
    return settled


def work(
    centre: Centre,
    wait: Callable[[float], object],
    stopped: Callable[[], bool],
    scheduler: str | None = None,
) -> None:
    """Works until it is stopped.

    Args:
        centre: the centre.
        wait: returns after some seconds, or sooner when there may be work.
        stopped: whether to end.
        scheduler: address of a Dask scheduler whose workers dream; None to dream here.
    """
    swept_ns = 0
    while not stopped():
        try:
            if work_off(centre):
                continue
            if centre.now_ns() - swept_ns >= centre.settings.sweep_h * _HOUR_NS:
                swept_ns = centre.now_ns()
                sweep_all(centre)
            if dream_a_while(centre, wait, stopped, scheduler):
                continue
        except (EngramError, OSError) as error:
            _log.error("%s; tried again in %g s", centre.words_of(error), _AGAIN_S)
            wait(_AGAIN_S)
        except Exception:  # of what robots sent: the others' work goes on
            _log.exception("an unexpected fault; tried again in %g s", _AGAIN_S)
            wait(_AGAIN_S)
        else:
            wait(centre.settings.poll_s)


def _make_downloads(centre: Centre, hindered: list[EngramError]) -> int:
    """Makes the requested downloads unless something hinders it: merging may take less room."""
    made = 0
    for name in {row.map for row in jobs.pending(centre, Artifact)}:
        with centre.lane(f"{name}.downloads") as is_ours:
            # Looked up again: other workers made some meanwhile.
            for row in jobs.pending(centre, Artifact, name) if is_ours and not hindered else ():
                try:
                    downloads.make(centre, row)
                    made += 1
                except (StorageFullError, StoreError) as error:
                    hindered.append(error)
                    break
    return made
