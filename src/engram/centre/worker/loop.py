"""The loop of a worker: it takes whatever map has work and a free lock."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from engram.centre.downloads import Downloads
from engram.centre.errors import StoreError
from engram.centre.handins import HandIns
from engram.centre.service import Centre
from engram.centre.worker.apart import merge_apart
from engram.centre.worker.dreaming import dream_a_while
from engram.centre.worker.merging import WaitsError
from engram.centre.worker.sweeping import sweep_all
from engram.errors import EngramError, StorageFullError

_log = logging.getLogger(__name__)
# A full disk takes a person: until then the same job is not tried four times a second.
_AGAIN_S = 10.0
_HOUR_NS = 3_600_000_000_000


def work_off(centre: Centre, take: Callable[[Centre, dict[str, Any]], None] = merge_apart) -> int:
    """Does what there is to do; returns the number of settled jobs.

    Args:
        centre: the centre.
        take: merges a hand-in.

    Raises:
        EngramError: what hinders the centre; of each map, after all of them had their turn. Jobs
            wait.
    """
    handins = HandIns(centre)
    settled, hindered = 0, list[EngramError]()
    handins.expire()
    Downloads(centre).expire()
    for name in centre.map_names():
        if not handins.waiting(name):
            continue
        try:
            with centre.lane(name) as is_ours:
                for row in handins.waiting(name) if is_ours else ():
                    settled += _make_downloads(centre, hindered)
                    take(centre, row)
                    settled += 1
        except WaitsError as error:  # the next map may have its disk and its drives
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
    downloads, made = Downloads(centre), 0
    for name in {row["map"] for row in downloads.asked()}:
        with centre.lane(f"{name}.downloads") as is_ours:
            for row in downloads.asked() if is_ours else ():  # again: others made some meanwhile
                if row["map"] != name or hindered:
                    continue
                try:
                    downloads.make(row)
                    made += 1
                except (StorageFullError, StoreError) as error:
                    hindered.append(error)
    return made
