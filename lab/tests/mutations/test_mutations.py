"""The harness itself: every outcome is told apart, and a case is its number."""

from __future__ import annotations

import os
import signal
import time

import cv2
import pytest

from engram_lab.checks.mutations import CHANGES, FAULTS, Harness
from engram_lab.mutations import forks
from engram_lab.mutations.forks import Limits, Outcome, tried


@pytest.fixture(scope="module")
def harness(tmp_path_factory):
    cv2.setNumThreads(0)
    return Harness(tmp_path_factory.mktemp("mutations"))


def test_a_few_changes_of_every_kind_do_no_harm(harness):
    for number in range(len(CHANGES)):
        kind, trial = harness.trial(number, seed=0)
        assert trial.outcome not in FAULTS, (kind, trial)


def test_a_case_is_its_number(harness):
    first, again = (harness.trial(3, seed=5)[1] for _ in range(2))
    assert (first.what, first.outcome) == (again.what, again.outcome)
    assert first.what != harness.trial(16, seed=5)[1].what


def crash(_):
    os.kill(os.getpid(), signal.SIGKILL)


def stumble(_):
    raise KeyError("a bug")


def bomb(_):
    return Outcome.READ, str(len(bytearray(3 * 2**30)))


def grow(_):
    return Outcome.READ, str(len(b"x" * (1100 * 2**20)))


def obey(_):
    os.system("true")
    return Outcome.READ, ""


def spin(_):
    while True:
        pass


def wait(_):
    time.sleep(100)


@pytest.mark.parametrize(
    ("work", "outcome"),
    [
        (lambda _: (Outcome.READ, ""), Outcome.READ),
        (crash, Outcome.CRASH),
        (stumble, Outcome.TRACEBACK),
        (bomb, Outcome.MEMORY),
        (grow, Outcome.MEMORY),
        (obey, Outcome.EXECUTED),
        (spin, Outcome.HANG),
        (wait, Outcome.HANG),
    ],
)
def test_each_outcome_is_told_apart(tmp_path, monkeypatch, work, outcome):
    limits = Limits(seconds=1.0) if work is spin else None
    if work is wait:
        monkeypatch.setattr(forks, "_STUCK_S", 0.5)
    assert tried(work, tmp_path, limits).outcome is outcome


def test_writing_outside_its_folder_is_a_deed(tmp_path):
    def write(_):
        (tmp_path / "elsewhere").write_text("owned")
        return Outcome.READ, ""

    inside = tmp_path / "inside"
    inside.mkdir()
    trial = tried(write, inside)
    assert trial.outcome is Outcome.EXECUTED
    assert "elsewhere" in trial.detail
