"""Γ(recall) as docs/ranking.md writes it down, one loop after another."""

import math

import numpy as np

NEEDED, PICKS, UNKNOWN_BASE, UNTRIED_RATE = 20, 8, 0.4, 0.3


def base(graph, attempts, savers) -> list[float]:
    """How likely anybody matches each node; attempts are (viewer, node, rate, accepted)."""
    good, bad = np.zeros(len(graph)), np.zeros(len(graph))
    for _, node, rate, accepted in attempts:
        if accepted:
            good[node] += 1
        else:
            bad[node] += rate
    for node in savers:
        good[node] += 2
    rates = []
    for i in range(len(graph)):
        a, b = 2 * UNKNOWN_BASE, 2 * (1 - UNKNOWN_BASE)
        for j in range(len(graph)):
            apart = abs(graph.driven_m[i] - graph.driven_m[j])
            if graph.experiences[i] == graph.experiences[j] and apart <= 4:
                a += math.exp(-apart / 3) * good[j]
                b += math.exp(-apart / 3) * bad[j]
        rates.append(a / (a + b))
    return rates


def rms(near, row) -> float:
    """Distance of a candidate, with how vaguely it is known."""
    return math.hypot(near.distance_m[row], near.sigma_m[row])


def tally(context, node, c) -> float:
    """What a node's drive wins by how often this run matched it."""
    run, sessions = context.run, context.graph.sessions
    good = bad = 0.0
    for k, other in enumerate(run.nodes):
        if sessions[other] == sessions[node]:
            weight = math.exp((run.at_m[k] - run.driven_m) / c.tally_memory_m)
            if run.accepted[k]:
                good += weight
            elif not math.isnan(run.rates[k]):
                bad += weight * run.rates[k]
    return c.tally * math.log((good + UNTRIED_RATE) / (good + bad + 1) / UNTRIED_RATE)


def order(context, rates, c, basin_m, choose=lambda margins, left: np.argmax(margins)) -> list[int]:
    """Rows best first. `rates` is of `base`, `c` the constants, `basin_m` the shipped one.

    `choose` takes the margins of the rows that are left, and the rows, and gives the place of the
    one to pick.
    """
    near, run, graph = context.neighbourhood, context.run, context.graph
    told: list[tuple[int, float, float]] = []
    for k, node in enumerate(run.nodes):
        distance = run.distance_m[k]
        if math.isnan(distance) and not run.accepted[k]:
            continue
        if run.accepted[k] or run.inliers[k] in range(1, NEEDED):
            margin = math.log(run.inliers[k] / NEEDED)
        else:
            margin = math.log(1 / NEEDED)
        if not math.isnan(distance):
            margin += c.distance * distance / basin_m
        if margin > c.level and not run.accepted[k]:
            continue
        told.append((node, math.exp((run.at_m[k] - run.driven_m) / c.memory_m), margin))
    costs = [
        c.distance * rms(near, row) / basin_m - tally(context, node, c)
        for row, node in enumerate(near.nodes)
    ]
    left = sorted(
        range(len(near)), key=lambda r: (near.distance_m[r], graph.node(int(near.nodes[r])).id)
    )
    picked: list[int] = []
    supposed: list[tuple[int, float]] = []
    while left:
        margins = []
        for row in left:
            node = near.nodes[row]
            p = rates[node]
            weight = c.prior_weight
            total = weight * (c.level + c.lessons * math.log(p / (1 - p)))
            for other, counts, margin in told:
                same = graph.sessions[other] == graph.sessions[node]
                weight += counts * (int(same) + int(other == node))
                total += counts * margin * (int(same) + int(other == node))
            for session, margin in supposed:
                if session == graph.sessions[node]:
                    weight += c.regret
                    total += c.regret * margin
            margins.append(total / weight - costs[row])
        best = left.pop(int(choose(margins, left)))
        picked.append(best)
        if len(picked) < PICKS:
            supposed.append((graph.sessions[near.nodes[best]], math.log(1 / NEEDED) + costs[best]))
    return picked
