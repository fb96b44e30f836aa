"""A hand-in in a process of its own, so that none can end the worker.

Whatever is raised in it ends that hand-in, and so does its death: by a fault of memory, or by a
system that is out of it. It is not tried again until an operator asks for that.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from engram.centre.handins import HandIns
from engram.centre.keeping import HandInState
from engram.centre.service import Centre
from engram.centre.settings import CentreSettings
from engram.centre.worker.merging import WaitsError, clear_scratch, merge_hand_in
from engram.errors import EngramError
from engram.logs import logging_to_stderr
from engram.processes import end_with_parent

_log = logging.getLogger(__name__)
# Chosen first by a system that is out of memory, before the worker and the service.
_FIRST_TO_GO = "1000"


def merge_apart(centre: Centre, row: dict[str, Any]) -> None:
    """Merges one complete hand-in, as `merge_hand_in` does.

    Raises:
        WaitsError: it waits for the centre.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    pipe, theirs = context.Pipe(duplex=False)
    given = (theirs, centre.folder, centre.addresses, centre.settings, row["id"])
    process = context.Process(target=_merge, args=given)
    process.start()
    theirs.close()
    try:
        waits_for = _told(pipe)
    except BaseException:
        process.kill()
        raise
    finally:
        pipe.close()
        process.join()
    if waits_for:
        raise WaitsError(waits_for)
    if HandIns(centre).get(row["id"])["state"] == HandInState.COMPLETE:
        _end_killer(centre, row, process)


def _told(pipe: Connection) -> str:
    """What the hand-in waits for; empty if it has ended, or its process."""
    try:
        waits_for: str = pipe.recv()
    except (EOFError, OSError):
        return ""
    return waits_for


def _end_killer(centre: Centre, row: dict[str, Any], process: BaseProcess) -> None:
    """Ends a hand-in whose process died."""
    code = process.exitcode or 0
    how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
    fact = f"the process that merged it ended {how}; an operator may have it merged anyway"
    _log.error("%s: hand-in %s: %s", row["map"], row["id"][:8], fact)
    clear_scratch(centre, row)
    HandIns(centre).end(row, HandInState.FAILED, error=fact)


def _merge(
    pipe: Connection,
    folder: Path,
    addresses: tuple[str | None, str | None],
    settings: CentreSettings,
    key: str,
) -> None:
    """Main function of the process: sends what the hand-in waits for, nothing if it has ended."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the worker ends it
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(_FIRST_TO_GO)
    with logging_to_stderr(), Centre(folder, *addresses, settings) as centre:
        try:
            merge_hand_in(centre, HandIns(centre).get(key))
        except (EngramError, OSError) as error:
            pipe.send(centre.words_of(error))
