"""What hangs together with the centre while a merge goes on, against counting components."""

import random
from uuid import UUID

import numpy as np
import pytest

from engram.fleet.merge.parts import Parts
from engram.geometry import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, Node, NodeId, SessionId


@pytest.mark.parametrize("seed", range(20))
def test_a_node_is_apart_while_no_edges_lead_from_it_to_what_was_there(seed: int) -> None:
    rng = random.Random(seed)
    graph, parts = ExperienceGraph(), Parts()
    session = SessionId(UUID(int=1))
    nodes = [NodeId(UUID(int=number)) for number in range(2, 22)]
    known = nodes[:5]
    for number, node in enumerate(nodes):
        graph.add_node(Node(node, session, number, "camera", float(number)))
        if node not in known:
            parts.take(node)
    for _ in range(15):
        a, b = rng.sample(nodes, 2)
        edge = Edge(a, b, EdgeKind.MATCH, SE3.identity(), np.eye(6))
        graph.add_edge(edge)
        parts.join(edge)
        labels = graph.components()
        there = set(labels[: len(known)].tolist())
        for number, node in enumerate(nodes):
            expected = node not in known and int(labels[number]) not in there
            assert parts.is_apart(node) == expected
