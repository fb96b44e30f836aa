"""Dreams, when nothing else is to do: given up for whatever a robot hands in or asks for.

A dream runs in a process of its own at low priority, which may be killed at any moment: what was
tried is kept next to the map, and the next one continues from there.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from engram.centre.downloads import Downloads
from engram.centre.dreams import Dreams
from engram.centre.handins import HandIns
from engram.centre.keeping import CANCELLED, DONE, FAILED
from engram.centre.refs import Refs
from engram.centre.service import Centre
from engram.centre.worker.admission import admit
from engram.centre.worker.watching import Watching
from engram.errors import EngramError, MapLockedError, StorageFullError
from engram.fleet.dream import DreamOptions, dream
from engram.maps import Map
from engram.processes import end_with_parent
from engram.robot import Settings

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
    dreams = Dreams(centre)
    dreams.ask_quietly()
    due = dreams.due()
    _clear_left(centre, due)
    for row in due:
        with centre.lane(row["map"]) as is_ours:
            if is_ours and not _is_asked_for(centre):
                _dream_beside(centre, row, wait, stopped, scheduler)
                return True
    return False


def _clear_left(centre: Centre, due: list[dict[str, Any]]) -> None:
    """Removes what killed dreams left that will not be resumed: copies of all robots' maps."""
    names = {f"dream-{row['id']}" for row in due}
    for folder in (centre.folder / "work").glob("dream-*"):
        if folder.name not in names:
            shutil.rmtree(folder, ignore_errors=True)


def _dream_beside(
    centre: Centre,
    row: dict[str, Any],
    wait: Callable[[float], object],
    stopped: Callable[[], bool],
    scheduler: str | None,
) -> None:
    context = multiprocessing.get_context("spawn")
    given = (centre.folder, *centre.addresses, row["id"], scheduler)
    process = context.Process(target=_dream_here, args=given)
    process.start()
    gives_up = False
    try:
        while process.is_alive() and not gives_up:
            wait(centre.settings.poll_s)
            gives_up = stopped() or _is_asked_for(centre) or not Dreams(centre).is_due(row)
    finally:
        process.kill()
        process.join()
    if process.exitcode and not gives_up:
        fact = f"its process ended with exit code {process.exitcode}"
        Dreams(centre).end(row, FAILED, error=fact)


def _is_asked_for(centre: Centre) -> bool:
    """Whether robots wait for a worker."""
    handins = HandIns(centre)
    return bool(Downloads(centre).asked()) or any(map(handins.waiting, centre.map_names()))


def _dream_here(
    folder: Path, database: str | None, objects: str | None, key: str, scheduler: str | None
) -> None:
    """Main function of the process."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the worker ends it
    os.nice(_NICENESS)
    with Centre(folder, database, objects) as centre:
        dream_of(centre, Dreams(centre).get(key), scheduler)


def dream_of(centre: Centre, row: dict[str, Any], scheduler: str | None = None) -> None:
    """Runs one dream to its end, and records the result in its row.

    A map that is being written to by hand, or a full disk, leaves the request pending.
    """
    dreams, policy = Dreams(centre), centre.policy(row["map"])
    options = DreamOptions(scheduler=scheduler, merging=policy.merge)
    drives = [Path(one) for one in policy.gate]
    watching = Watching(partial(dreams.heartbeat, row["id"]))
    path = centre.map_path(row["map"])
    try:
        with _scratch(centre.folder / "work" / f"dream-{row['id']}") as folder:
            handed = list(_handed(centre, row["map"], folder))
            report = dream(path, handed, drives, Settings(), options, watching)
    except (MapLockedError, StorageFullError):
        return
    except KeyboardInterrupt:
        dreams.end(row, CANCELLED, error="cancelled")
        return
    except EngramError as error:
        dreams.end(row, FAILED, error=centre.words_of(error))
        return
    told = report.to_dict() | {"centre": row["map"]}
    if report.added is None:
        revision = _made_before(path, row["since"])
    else:
        revision, told["added"]["out"] = report.added.revision, row["map"]
    dreams.end(row, DONE, revision=revision, report=told)
    if policy.moves is not None and revision is not None:
        Refs(centre).move(row["map"], policy.moves, revision, "dream", None)


def _made_before(path: Path, since: int) -> int | None:
    """The revision that this dream made before its process died; else None."""
    with Map.open(path) as store:
        made = [one.number for one in store.log() if one.message.startswith("dream: ")]
    return max((one for one in made if one > since), default=None)


def _handed(centre: Centre, name: str, folder: Path) -> Iterator[Path]:
    """Robots' maps as they were handed in, oldest first."""
    dreams, limits = Dreams(centre), centre.settings
    for number, row in enumerate(dreams.handed(name)):
        path, manifest = folder / f"{number:04}.engram", dreams.manifest(row)
        parts = dreams.parts(row, manifest)
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
