"""What a download promises: never less with more nodes, and chosen as well as it can be."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from tests.builders import drive, map_simulated

from engram.fleet.download.coverage import (
    Coverage,
    Demand,
    affinities,
    expected_missed,
    greedy_order,
)
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.part import Stock
from engram.fleet.download.selections import coverage_for
from engram.graph.basin import MatchBasin
from engram.maps.map import Map

from .robots import DAY_NS, WORLD

HOUR_NS = 3_600_000_000_000


def random_coverage(seed: int, places: int = 6, sessions: int = 4, nodes: int = 9) -> Coverage:
    """A coverage of any numbers, without a map behind it."""
    rng = np.random.default_rng([3, seed])
    weight = rng.random((places, sessions)) * (rng.random((places, 1)) < 0.9)
    made = Coverage.__new__(Coverage)
    made.demand = Demand(np.arange(places), weight)
    made._affinity = rng.uniform(0.02, 0.98, (sessions, sessions))
    made._session_of = rng.integers(0, sessions, nodes)
    made._reached = {
        node: (reached, rng.uniform(0, 0.97, len(reached)))
        for node in range(nodes)
        if len(reached := np.flatnonzero(rng.random(places) < 0.4))
    }
    made.clear()
    return made


def missed_by_definition(coverage: Coverage, chosen: set[int]) -> float:
    """Σ w Π_e (1 − a·(1 − Π_n (1 − g))) / Σ w, written out."""
    total = 0.0
    for place, session in np.ndindex(coverage.demand.weight.shape):
        fails: dict[int, float] = {}
        for node in chosen:
            reached, rates = coverage._reached.get(node, (np.zeros(0, int), np.zeros(0)))
            for at, rate in zip(reached, rates, strict=True):
                if at == place:
                    other = int(coverage._session_of[node])
                    fails[other] = fails.get(other, 1.0) * (1 - rate)
        missed = coverage.demand.weight[place, session]
        for other, failing in fails.items():
            missed *= 1 - coverage._affinity[session, other] * (1 - failing)
        total += missed
    return total / coverage.demand.total


@pytest.mark.parametrize("seed", range(10))
def test_the_running_figure_is_the_formula(seed):
    coverage = random_coverage(seed)
    chosen: set[int] = set()
    for node in np.random.default_rng(seed).permutation(9).tolist():
        before, gain = coverage.expected_missed, coverage.gain(node)
        coverage.add(node)
        chosen.add(node)
        after = missed_by_definition(coverage, chosen)
        assert coverage.expected_missed == pytest.approx(after, abs=1e-12)
        assert gain == pytest.approx((before - after) * coverage.demand.total, abs=1e-12)


@pytest.mark.parametrize("seed", range(10))
def test_a_node_helps_the_less_the_more_there_is(seed):
    coverage = random_coverage(seed)
    gains = np.array([coverage.gain(node) for node in range(9)])
    assert (gains >= 0).all()
    for node in np.random.default_rng(seed).permutation(9).tolist():
        coverage.add(node)
        now = np.array([coverage.gain(one) for one in range(9)])
        assert (now <= gains + 1e-12).all()
        gains = now


@pytest.mark.parametrize("seed", range(6))
def test_greedy_comes_close_to_the_best_subset(seed):
    coverage = random_coverage(seed)
    size = np.ones(9)
    order, _ = greedy_order(coverage, size, np.arange(9))
    assert sorted(order.tolist()) == list(range(9))
    for count in (1, 2, 3, 4):
        found = 1 - missed_by_definition(coverage, set(order[:count].tolist()))
        best = max(
            1 - missed_by_definition(coverage, set(chosen))
            for chosen in combinations(range(9), count)
        )
        # Nemhauser, Wolsey and Fisher 1978.
        assert found >= (1 - 1 / np.e) * best - 1e-12


@pytest.mark.parametrize("seed", range(6))
def test_lazy_takes_what_looking_at_all_would_take(seed):
    coverage = random_coverage(seed, nodes=20)
    size = np.random.default_rng(seed).uniform(1, 3, 20)
    found, gains = greedy_order(coverage, size, np.arange(20))
    order = found.tolist()
    coverage.clear()
    for place, taken in enumerate(order):
        ratios = {node: coverage.gain(node) / size[node] for node in order[place:]}
        if max(ratios.values()) <= 1e-9:
            assert not gains[place:].any()
            break
        assert gains[place] == ratios[taken]
        assert ratios[taken] == pytest.approx(max(ratios.values()), rel=1e-12)
        coverage.add(taken)


@pytest.fixture(scope="module")
def centre(tmp_path_factory) -> Path:
    """Mornings and evenings that do not match each other, over the same 30 m."""
    path = tmp_path_factory.mktemp("fleet") / "centre.engram"
    for day, (hour, appearance) in enumerate(((9.0, 0), (18.0, 1), (9.5, 0), (18.2, 1)), start=1):
        places = np.arange(0, 30, 0.5)
        steps = drive(
            WORLD, places, np.where(places < 3, 0, appearance), aside_m=0.1 * day,
            start_ns=day * DAY_NS + round(hour * HOUR_NS), seed=day,
        )  # fmt: skip
        map_simulated(path, steps, f"r{day}", longitude_deg=0.0)
    return path


@pytest.fixture
def stock(centre):
    with Map.open(centre) as store:
        yield Stock(store)


def test_who_got_on_with_whom_is_learnt_from_attempts_and_hours(stock):
    found = affinities(stock, MatchBasin.of(400.0, stock.store.totals().basin_counts))
    r1, r2, r3, r4 = range(4)
    # r3 matched what r1 saved again and again, r4 what r2 saved; crosswise nothing matched.
    assert found[r3, r1] > 0.8
    assert found[r4, r2] > 0.8
    assert found[r4, r1] < found[r4, r2] - 0.3
    assert found[r2, r1] < found[r3, r1] - 0.2


def test_a_mission_asks_for_the_map_of_its_own_hour(stock):
    robots = np.array([stock.sessions[at].robot for at in stock.session_of])
    for hour, own in ((9.2, "r1"), (18.1, "r2")):
        coverage = coverage_for(stock, DownloadOptions(depart_h=hour))
        missed = {robot: expected_missed(coverage, robots == robot) for robot in ("r1", "r2")}
        other = "r2" if own == "r1" else "r1"
        assert missed[own] + 0.2 < missed[other]
        everything = expected_missed(coverage, stock.everything())
        assert everything <= missed[own]
        order, _ = greedy_order(coverage, np.ones(len(stock)), np.arange(len(stock)))
        assert (robots[order[:6]] == own).all()


def test_elsewhere_asks_for_nothing(stock):
    """Every drive began at 0 m of the street: the distance driven is the place."""
    driven_m = np.array([node.driven_m for node in stock.nodes])
    where, far = driven_m < 5, driven_m > 20
    anywhere = coverage_for(stock, DownloadOptions())
    stock.area = where
    near = coverage_for(stock, DownloadOptions())
    assert 0 < near.demand.total < anywhere.demand.total / 3
    assert expected_missed(near, far) == 1.0
    assert expected_missed(near, where | far) == expected_missed(near, where) < 0.9


def test_nobody_anywhere_is_all_missed():
    coverage = random_coverage(0)
    coverage.demand = Demand(np.arange(6), np.zeros((6, 4)))
    coverage.clear()
    assert coverage.expected_missed == 1.0
