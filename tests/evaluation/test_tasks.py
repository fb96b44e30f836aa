"""Tasks that several processes run."""

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from engram.errors import WorkerError
from engram.evaluation.tasks import Task, run_tasks


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
        run_tasks(tasks, 2, lambda _: None)
    assert first.read_text() == "done"
