"""The loop of a worker: it takes whatever map has work and a free lock."""

from __future__ import annotations

from collections.abc import Callable

from engram.centre.downloads import Downloads
from engram.centre.handins import HandIns
from engram.centre.service import Centre
from engram.centre.worker.dreaming import dream_a_while
from engram.centre.worker.merging import merge_hand_in
from engram.centre.worker.sweeping import sweep_all

_HOUR_NS = 3_600_000_000_000


def work_off(centre: Centre) -> int:
    """Does what there is to do; returns the number of settled jobs."""
    downloads, handins = Downloads(centre), HandIns(centre)
    settled = 0
    handins.expire()
    downloads.expire()
    for name in centre.map_names():
        if not handins.waiting(name):
            continue
        with centre.lane(name) as is_ours:
            for row in handins.waiting(name) if is_ours else ():
                settled += _make_downloads(downloads)
                if not merge_hand_in(centre, row):
                    break  # somebody writes to this map by hand
                settled += 1
    return settled + _make_downloads(downloads)


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
        if work_off(centre):
            continue
        if centre.now_ns() - swept_ns >= centre.settings.sweep_h * _HOUR_NS:
            swept_ns = centre.now_ns()
            sweep_all(centre)
        if dream_a_while(centre, wait, stopped, scheduler):
            continue
        wait(centre.settings.poll_s)


def _make_downloads(downloads: Downloads) -> int:
    asked = downloads.asked()
    for row in asked:
        downloads.make(row)
    return len(asked)
