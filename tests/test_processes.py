"""Work in processes."""

from __future__ import annotations

import os

import pytest

from engram.monitor import QUIET, Monitor
from engram.processes import run_in_processes

_THREADS = "OPENBLAS_NUM_THREADS"


def _blas_threads(_: None, monitor: Monitor) -> str | None:
    del monitor
    return os.environ.get(_THREADS)


@pytest.mark.parametrize(("given", "used"), [(None, "1"), ("3", "3")])
def test_a_worker_has_one_thread_of_blas_unless_told_otherwise(
    given: str | None, used: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(_THREADS, raising=False)
    if given is not None:
        monkeypatch.setenv(_THREADS, given)
    found: dict[str, str | None] = {}
    run_in_processes(
        _blas_threads,
        {"a": None, "b": None},
        2,
        QUIET,
        lambda name, result, _: found.update({name: result}),
    )
    assert found == {"a": used, "b": used}
    assert os.environ.get(_THREADS) == given
