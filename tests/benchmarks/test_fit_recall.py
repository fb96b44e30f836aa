"""Fitting the constants of Γ(recall): the regression, and what it is fed."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
from tests.worlds import make_context

from engram.ranking import policy_named
from engram.ranking.recall import RECALL, RecallPolicy

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import fit_recall


def seen(accepted, session: int = 0, **situation) -> fit_recall.Seen:
    context = make_context(sessions=2, **situation)
    return fit_recall.Seen(session, context, np.array(accepted))


def test_regression_finds_the_factors_that_made_the_outcomes() -> None:
    rng = np.random.default_rng(0)
    factors = np.array([-0.5, 1.2, 0.4, 0.0])
    x = np.column_stack([np.ones(20_000), rng.normal(0, 1, (20_000, 3))])
    y = rng.random(20_000) < 1 / (1 + np.exp(-x @ factors))
    # Standard errors of about 0.02 at 20,000 outcomes.
    np.testing.assert_allclose(fit_recall.fit(x, y), factors, atol=0.08)


def test_features_times_factors_are_the_log_odds_of_the_policy() -> None:
    one = seen(
        [True, False, True],
        candidates=[0, 1, 2],
        along_m=[0.5, 1.0, 1.5],
        run=[(-1.0, 0, 0.9, True), (-2.0, 1, 0.9, False)],
        hour=9.0,
        hours=[8.0, 17.0],
        lessons=[(0, 1, 0.9, False)],
    )
    factors = [getattr(RECALL, name) for name in fit_recall.FACTORS]
    odds = fit_recall.features([one], RECALL, clock=True) @ factors
    terms = RecallPolicy().judge(one.context).terms
    np.testing.assert_allclose(odds, sum(terms.values()))


def test_a_frame_is_missed_where_all_first_picks_fail_and_something_would_match() -> None:
    frames = [
        seen([False, False, True], candidates=[0, 1, 2]),
        seen([False, True, False], candidates=[0, 1, 2]),
        seen([False, False, False], candidates=[0, 1, 2]),
    ]
    distance = policy_named("distance")
    assert fit_recall.missed(frames, distance).tolist() == [True, False]
    assert fit_recall.missed(frames, distance, lanes=3).tolist() == [False, False]


def test_the_search_leaves_no_setting_out() -> None:
    fields = {field.name for field in dataclasses.fields(RECALL)}
    assert {*fit_recall.FACTORS, *fit_recall.SEARCHED, "regret"} == fields
