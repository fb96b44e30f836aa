"""Fitting the constants of Γ(recall): the replay of policies, and the search."""

import dataclasses

import numpy as np
import pytest

from engram.ranking.context import Foreseen
from engram.ranking.policies import policy_named
from engram.ranking.recall import RECALL
from engram.testing.contracts import make_context
from engram_lab.fits import recall


def frame(accepted, driven_m: float = 0.0, step_m: float = 1.0, **situation) -> recall.Seen:
    context = make_context(sessions=2, **situation)
    accepted = np.array(accepted)
    return recall.Seen(context, Foreseen(accepted, np.where(accepted, 50, 0)), driven_m, step_m)


def drive(*frames: recall.Seen) -> recall.Recorded:
    return recall.Recorded("made up", frames, sum(one.step_m for one in frames))


def test_the_route_is_missed_where_all_first_picks_fail_and_something_would_match() -> None:
    whole = drive(
        frame([False, False, True], candidates=[0, 1, 2], step_m=3.0),
        frame([False, True, False], candidates=[0, 1, 2]),
        frame([False, False, False], candidates=[0, 1, 2]),
    )
    distance = policy_named("distance")
    assert recall.missed(whole, distance) == pytest.approx(3 / 5)
    assert recall.missed(whole, distance, lanes=1) == pytest.approx(4 / 5)
    assert recall.missed(whole, distance, lanes=3) == 0


def test_a_replayed_policy_learns_from_its_own_picks_alone() -> None:
    ahead = {"candidates": [0, 1], "along_m": [0.0, 0.3]}
    whole = drive(*(frame([False, True], float(k), **ahead) for k in range(4)))
    steps = list(recall.replay(whole, policy_named("bandit"), lanes=1))
    picks = [int(one[2][0]) for one in steps]
    assert picks[0] == 0
    assert picks[-1] == 1
    for number, (_, context, _) in enumerate(steps):
        assert context.run.nodes.tolist() == picks[:number]
        assert context.run.accepted.tolist() == [pick == 1 for pick in picks[:number]]
        assert set(context.observations.nodes.tolist()) == set(picks[:number])
        assert context.reference == (1 if 1 in picks[:number] else None)


def test_the_search_finds_the_least_on_its_grid() -> None:
    target = {name: values[0] for name, values in recall.SEARCHED.items()}

    def cost(constants) -> float:
        return sum((getattr(constants, name) - value) ** 2 for name, value in target.items())

    found = recall.search(cost)
    assert {name: getattr(found, name) for name in target} == target


def test_of_equally_good_constants_those_that_stand_are_kept() -> None:
    assert recall.search(lambda constants: 0.0) == RECALL


def test_chances_come_from_the_odds_that_made_the_outcomes() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(0, 1, 20_000)
    y = rng.random(20_000) < 1 / (1 + np.exp(-(0.6 + 1.8 * x)))
    # Standard errors of about 0.02 at 20,000 outcomes.
    assert recall.logistic(x, y) == pytest.approx((0.6, 1.8), abs=0.08)


def test_the_search_leaves_no_constant_out() -> None:
    fields = {one.name for one in dataclasses.fields(RECALL)}
    assert {*recall.SEARCHED, *recall.CHANCES, *recall.WHEN_LOST, *recall.COUNTED} == fields
