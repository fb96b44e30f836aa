"""Γ(recall) as docs/ranking.md writes it down, with dense tables and one loop after another."""

import math

import numpy as np

PSEUDO, NOBODY, PICKS, UNKNOWN_BASE = 0.5, 1.0, 8, 0.4


def logit(p: float) -> float:
    p = min(max(p, 1e-3), 1 - 1e-3)
    return math.log(p / (1 - p))


def lessons(graph, viewers: int, attempts, savers) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rates (N, V), whether there is evidence (N, V), and base (N,)."""
    count = len(graph)
    good, bad = np.zeros((count, viewers)), np.zeros((count, viewers))
    for viewer, node, rate, accepted in attempts:
        if accepted:
            good[node, viewer] += 1
        else:
            bad[node, viewer] += rate
    for node, viewer in enumerate(savers):
        good[node, viewer] += 2
    shared_good, shared_bad = np.zeros_like(good), np.zeros_like(bad)
    seen = np.zeros(good.shape, bool)
    for i in range(count):
        for j in range(count):
            apart = abs(graph.driven_m[i] - graph.driven_m[j])
            if graph.experiences[i] == graph.experiences[j] and apart <= 4:
                weight = math.exp(-apart / 3)
                shared_good[i] += weight * good[j]
                shared_bad[i] += weight * bad[j]
                seen[i] |= good[j] + bad[j] > 0
    total = shared_good + shared_bad
    base = (shared_good.sum(1) + 2 * UNKNOWN_BASE) / (total.sum(1) + 2)
    rates = np.clip((shared_good + base[:, None]) / (total + 1), 1e-3, 1 - 1e-3)
    return rates, seen, base


def order(context, table, c, viewer_hours, choose=lambda odds, left: np.argmax(odds)) -> list[int]:
    """Rows best first. `table` is of `lessons`, `c` the constants.

    `choose` takes the log odds of the rows that are left, and the rows, and gives the place of the
    one to pick.
    """
    rates, seen, base = table
    near, run, graph = context.neighbourhood, context.run, context.graph
    g = context.success_rates()
    decayed = [math.exp(at / c.viewers_m) for at in run.at_m - run.driven_m]
    weights = np.zeros(len(viewer_hours))
    if context.hour is not None:
        weights += [c.viewer_hour * hours_apart(h, context.hour) for h in viewer_hours]
    for k, node in enumerate(run.nodes):
        for viewer in np.flatnonzero(seen[node]):
            p = rates[node, viewer]
            if run.accepted[k]:
                weights[viewer] += c.trust * decayed[k] * math.log(p / base[node])
            elif not np.isnan(run.rates[k]):
                gain = math.log((1 - p) / (1 - base[node]))
                weights[viewer] += c.trust * decayed[k] * run.rates[k] * gain
    good, bad = np.zeros(len(near)), np.zeros(len(near))
    node_good, node_bad = np.zeros(len(near)), np.zeros(len(near))
    for k, node in enumerate(run.nodes):
        weight = 1.0 if run.accepted[k] else np.nan_to_num(run.rates[k])
        for row in range(len(near)):
            own = math.exp((run.at_m[k] - run.driven_m) / c.own_m) * weight
            very = math.exp((run.at_m[k] - run.driven_m) / c.node_m) * weight
            if graph.sessions[node] == graph.sessions[near.nodes[row]]:
                (good if run.accepted[k] else bad)[row] += own
            if node == near.nodes[row]:
                (node_good if run.accepted[k] else node_bad)[row] += very
    left = sorted(
        range(len(near)), key=lambda r: (near.distance_m[r], graph.node(int(near.nodes[r])).id)
    )
    picked: list[int] = []
    hours = context.background.times.hours(graph, context.sessions)
    while left:
        mixture = np.exp(weights - max(weights.max(initial=0.0), 0.0))
        nobody = math.exp(math.log(NOBODY) - max(weights.max(initial=0.0), 0.0))
        mixture = mixture / (mixture.sum() + nobody)
        chances = []
        for row in left:
            node = near.nodes[row]
            company = base[node] + (mixture * seen[node] * (rates[node] - base[node])).sum()
            odds = c.bias + c.offset * math.log(max(g[row], 1e-4)) + c.company * logit(company)
            odds += c.own * math.log((good[row] + PSEUDO) / (bad[row] + PSEUDO))
            odds += c.node * math.log((node_good[row] + PSEUDO) / (node_bad[row] + PSEUDO))
            if context.hour is not None:
                odds += c.hour * hours_apart(hours[row], context.hour)
            chances.append(odds)
        best = left.pop(int(choose(chances, left)))
        picked.append(best)
        if len(picked) >= PICKS:
            continue
        node, rate = near.nodes[best], min(g[best], 1 - 1e-3)
        for viewer in range(len(weights)):
            p = rates[node, viewer] if seen[node, viewer] else base[node]
            weights[viewer] += c.regret * math.log((1 - rate * p) / (1 - rate * base[node]))
        bad[context.sessions == context.sessions[best]] += c.regret * rate
    return picked


def hours_apart(a: float, b: float) -> float:
    if math.isnan(a):
        return 4.0
    apart = abs(a - b) % 24
    return min(apart, 24 - apart, 8.0)
