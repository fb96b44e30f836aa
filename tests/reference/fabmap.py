"""FAB-MAP's likelihood word by word, as published: the oracle of `engram.places.recognisers`.

Source: Cummins & Newman, FAB-MAP, IJRR 27(6), 2008, §4. Shares no code with the package.
"""

from __future__ import annotations

import math


def smoothed(count: float, images: int) -> float:
    return (count + 0.5) / (images + 1)


def log_likelihood(
    query: set[int],
    place: set[int] | None,
    images: int,
    seen: list[int],
    parents: list[int],
    seen_with_parent: list[int],
    hit: float,
    false_alarm: float,
) -> float:
    """log p(Z | L): the root words by the detector alone, the rest given their parents.

    Args:
        query: words of the image.
        place: words that the place was seen to show.
        images, seen, parents, seen_with_parent: training counts.
        hit, false_alarm: p(z = 1 | e = 1) and p(z = 1 | e = 0).
    """
    total = 0.0
    for q in range(len(seen)):
        z = q in query
        existence = belief(q in place, smoothed(seen[q], images), hit, false_alarm)
        probability = 0.0
        for e in (False, True):
            p_e = existence if e else 1 - existence
            probability += p_e * observation(
                z, e, q, query, images, seen, parents, seen_with_parent, hit, false_alarm
            )
        total += math.log(probability)
    return total


def detector(z: bool, e: bool, hit: float, false_alarm: float) -> float:
    p = hit if e else false_alarm
    return p if z else 1 - p


def belief(shown: bool, p_seen: float, hit: float, false_alarm: float) -> float:
    """p(e = 1 | what the place showed), by Bayes' rule."""
    prior = min(max((p_seen - false_alarm) / (hit - false_alarm), 1e-6), 1 - 1e-3)
    there = detector(shown, True, hit, false_alarm) * prior
    absent = detector(shown, False, hit, false_alarm) * (1 - prior)
    return min(max(there / (there + absent), 1e-6), 1 - 1e-3)


def observation(z, e, q, query, images, seen, parents, seen_with_parent, hit, false_alarm) -> float:
    """p(z_q | e_q, z_parent)."""
    parent = parents[q]
    if parent < 0:
        return detector(z, e, hit, false_alarm)
    p_seen = smoothed(seen[q], images)
    if parent in query:
        p_given = (seen_with_parent[q] + p_seen) / (seen[parent] + 1)
    else:
        p_given = (seen[q] - seen_with_parent[q] + p_seen) / (images - seen[parent] + 1)
    p_z = p_seen if z else 1 - p_seen
    p_z_given = p_given if z else 1 - p_given
    alpha = p_z * detector(not z, e, hit, false_alarm) * (1 - p_z_given)
    beta = (1 - p_z) * detector(z, e, hit, false_alarm) * p_z_given
    return 1 / (1 + alpha / beta) if beta > 0 else 0.0
