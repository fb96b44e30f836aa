"""Processes that work for another one: none outlives it."""

from __future__ import annotations

import multiprocessing
import os
import threading
from multiprocessing.connection import wait


def end_with_parent() -> None:
    """Ends this process as soon as its parent is gone, however that was killed.

    A worker left behind would hold locks and write files, and meet the run that goes on. To be
    called in the worker, whose work must be sound whenever it ends.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch(sentinel: int) -> None:
        wait([sentinel])
        os._exit(1)

    threading.Thread(target=watch, args=(parent.sentinel,), daemon=True).start()
