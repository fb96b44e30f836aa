"""Least uncertain chains in plain Python: the oracle of the search kernel."""

import heapq

import numpy as np
from tests.reference.chain_error import error_of

from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph

LEVER_M = 10.0


def chains(graph: ExperienceGraph, root: int, anchor=None, reach_m: float = np.inf):
    """node -> (root_from_node, [(tau, v, pivot in root)], cost), as Dijkstra settles them."""
    edges = [[] for _ in range(len(graph))]
    for edge in graph.edges:
        error = error_of(edge.covariance)
        a, b = graph.index(edge.a), graph.index(edge.b)
        edges[a].append((b, edge.a_from_b, error, error.pivot_in_a))
        b_from_a = edge.a_from_b.inverse()
        edges[b].append((a, b_from_a, error, b_from_a @ error.pivot_in_a))
    settled = {}
    heap = [(0.0, root, SE3.identity(), [])]
    while heap:
        cost, node, root_from_node, errors = heapq.heappop(heap)
        if node in settled:
            continue
        settled[node] = (root_from_node, errors, cost)
        if anchor is not None and np.linalg.norm(root_from_node.translation - anchor) > reach_m:
            continue
        for target, node_from_target, error, pivot_in_node in edges[node]:
            if target in settled:
                continue
            pivot = root_from_node @ pivot_in_node
            lever = LEVER_M**2 + (0 if anchor is None else np.sum((pivot - anchor) ** 2))
            step = error.translation_var + error.rotation_var * lever
            term = (error.translation_var, error.rotation_var, pivot)
            entry = (cost + step, target, root_from_node @ node_from_target, [*errors, term])
            heapq.heappush(heap, entry)
    return settled


def neighbourhood(
    graph,
    reference,
    reference_from_live,
    covariance,
    radius_m,
    gate_rad,
    margin_m,
    vague_m,
    detour_m,
):
    """node -> (node_from_live, sigma_m, sigma_yaw_rad) of the candidates, no slack."""
    live = reference_from_live.translation
    reach_m = max(radius_m, float(np.linalg.norm(live))) + margin_m
    own = error_of(covariance)
    own_term = (own.translation_var, own.rotation_var, own.pivot_in_a)
    wide = chains(graph, reference, live, reach_m + detour_m)

    def sight(pose, errors):
        node_from_live = pose.inverse() @ reference_from_live
        near = node_from_live.distance_m <= radius_m and abs(node_from_live.yaw_rad) <= gate_rad
        terms = [*errors, own_term]
        sigma_yaw = np.sqrt(sum(v for _, v, _ in terms))
        return near, (node_from_live, np.sqrt(variance_at(live, terms)), sigma_yaw)

    found = {}
    for node, (pose, errors, _) in chains(graph, reference, live, reach_m).items():
        near, seen = sight(pose, errors)
        if near and variance_at(live, errors) > vague_m**2:
            near, seen = sight(*wide[node][:2])
        if near:
            found[node] = seen
    return found


def variance_at(point, terms):
    """Of a chain's translation, as seen at a point."""
    return sum(tau + v * np.sum((point - pivot) ** 2) for tau, v, pivot in terms)
