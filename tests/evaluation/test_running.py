"""Cross-validation end to end, on tiny synthetic campaigns."""

from pathlib import Path

import numpy as np
import pytest
from tests.evaluation.campaigns import few_options, write_campaign

from engram.drive import Settings
from engram.evaluation import Configuration, DriveSet, Plan, make_plan, run
from engram.evaluation.store import read_runs


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> DriveSet:
    return write_campaign(tmp_path_factory.mktemp("campaign"))


def results(plan: Plan, mode: str = "memo") -> dict:
    """Everything but times, by session and configuration."""
    found = {}
    for session in range(len(plan.drives.drives)):
        runs = read_runs(plan.runs_path(session, mode))
        if runs is None:
            continue
        for row, one in enumerate(runs.configurations):
            found[session, one] = tuple(
                getattr(runs, name)[row].tobytes()
                for name in ("matched", "attempts", "candidates", "succeeded", "offset_m")
            )
    return found


@pytest.fixture(scope="module")
def plan(campaign, tmp_path_factory) -> Plan:
    plan = make_plan(campaign, Settings(), few_options(), tmp_path_factory.mktemp("work"))
    run(plan)
    return plan


def test_every_session_is_localised_with_every_configuration(plan: Plan) -> None:
    assert {session for session, _ in results(plan)} == set(range(8))
    runs = read_runs(plan.runs_path(0, "memo"))
    assert runs.matched.shape == (len(runs.configurations), len(runs.step_m))
    # Look 0 is in every fold's training sessions: its drives are localised nearly everywhere.
    assert runs.matched[runs.configurations.index(Configuration("path", 2))].mean() > 0.9
    assert np.nanmax(runs.offset_m) < 0.5


def test_two_workers_and_one_give_the_same(campaign, plan: Plan, tmp_path: Path) -> None:
    other = make_plan(campaign, Settings(), few_options(), tmp_path)
    run(other, workers=2)
    assert results(other) == results(plan)
