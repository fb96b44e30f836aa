"""Tasks that several processes run."""

import os
import select
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from engram.errors import WorkerError
from engram.monitor import QUIET
from engram_lab.studies.plan import Task, run_tasks


def _write(path: Path) -> None:
    path.write_text("done")


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_worker_that_dies_is_said_in_one_line(tmp_path: Path) -> None:
    first = tmp_path / "first"
    tasks = [
        Task("first", partial(_write, first)),
        Task("second", _die, needs=("first",)),
    ]
    with pytest.raises(WorkerError, match=r"a worker of 2 died .* --workers"):
        run_tasks(tasks, 2, QUIET)
    assert first.read_text() == "done"


@pytest.mark.long
def test_workers_end_with_a_run_that_is_killed() -> None:
    """Left behind, they would write where the run that goes on writes."""
    program = "from lab.tests.evaluation.test_tasks import wait_for_ever; wait_for_ever()"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        workers = [os.pidfd_open(int(parent.stdout.readline())) for _ in range(2)]
        parent.kill()
    for worker in workers:
        ended, _, _ = select.select([worker], [], [], 60)
        os.close(worker)
        assert ended


def wait_for_ever() -> None:
    """In a process of its own: two workers that tell who they are and do not end."""
    run_tasks([Task("one", _tell_and_wait), Task("two", _tell_and_wait)], 2, QUIET)


def _tell_and_wait() -> None:
    os.write(1, f"{os.getpid()}\n".encode())
    signal.pause()
