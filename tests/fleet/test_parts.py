"""What hangs together with the centre while a merge goes on, against counting components."""

import random
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock
from uuid import UUID

import numpy as np
import pytest

from engram.fleet.merge.open_merge import Merge
from engram.geometry.se3 import SE3
from engram.graph.model import Edge, EdgeKind, Node, NodeId, SessionId
from engram.maps.map import Map


@pytest.fixture
def merge(tmp_path: Path) -> Iterator[Merge]:
    with Map.create(tmp_path / "empty.engram") as store:
        found = Merge(store, store)
        found.writer = Mock()
        yield found


@pytest.mark.parametrize("seed", range(20))
def test_a_node_is_apart_while_no_edges_lead_from_it_to_what_was_there(
    seed: int, merge: Merge
) -> None:
    rng = random.Random(seed)
    session = SessionId(UUID(int=1))
    ids = [NodeId(UUID(int=number)) for number in range(2, 22)]
    nodes = [Node(one, session, at, "camera", float(at)) for at, one in enumerate(ids)]
    known = ids[:5]
    for node in nodes[:5]:
        merge.graph.add_node(node)
    for node in nodes[5:]:
        merge.take(Mock(node=node), Mock())
    for _ in range(15):
        a, b = rng.sample(ids, 2)
        merge.add_edge(Edge(a, b, EdgeKind.MATCH, SE3.identity(), np.eye(6)))
        labels = merge.graph.components()
        there = set(labels[: len(known)].tolist())
        for number, node in enumerate(ids):
            expected = node not in known and int(labels[number]) not in there
            assert merge.is_apart(node) == expected
