"""What a frame costs depends on what is near, not on the size of the map or on the time driven.

Work is counted as memory that is taken for the moment: arrays over all nodes or edges show in it.
"""

import itertools
import tracemalloc
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
from tests.builders import forward, make_edge

from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import EdgeKind, PathEntry, PathEntryKind, path_id
from engram.graph.proximity import lay_proximity_edges, tighten_chain
from engram.localiser.acceptance import AcceptanceConfig
from engram.localiser.fixes import MOST_ON_TRIAL, FixChain
from engram.localiser.localisation import Position
from engram.mapper.loops import LoopSearch
from engram.mapper.mapper import Memory, Records, Saver
from engram.testing.contracts import make_node

CHAIN = 20
# Of Python's own; an array of one byte per node of the larger map is larger.
SLACK_BYTES = 3_000
BESIDE = forward(0.0, across_m=1.0)
SHARP = (0.02, 0.001)


def map_with_a_chain(nodes: int) -> tuple[ExperienceGraph, list[int]]:
    """A road of so many nodes, and beside its first metres a chain of another session."""
    graph = ExperienceGraph()
    known, live = ([make_node(s, i) for i in range(n)] for s, n in ((0, nodes), (1, CHAIN)))
    for node in [*known, *live]:
        graph.add_node(node)
    steps = [make_edge(a.id, b.id, forward(1.0)) for a, b in itertools.pairwise(known)]
    steps += [make_edge(a.id, b.id, forward(1.0)) for a, b in itertools.pairwise(live)]
    graph.add_edges(steps)
    # Last and alone: the columns double here, and not while work is counted.
    graph.add_edge(make_edge(known[0].id, live[0].id, BESIDE, EdgeKind.TIE, SHARP))
    return graph, [graph.index(node.id) for node in live]


def taken_bytes(work: Callable[[], object]) -> int:
    """Most memory that is in use at once while the work is done."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_tying_a_chain_takes_as_much_in_a_large_map_as_in_a_small_one() -> None:
    taken = []
    for nodes in (200, 4_000):
        graph, chain = map_with_a_chain(nodes)
        for node in chain:
            lay_proximity_edges(graph, node)
        end = graph.node(CHAIN - 1).id
        graph.add_edge(make_edge(end, graph.node(chain[-1]).id, BESIDE, EdgeKind.TIE, SHARP))
        edges = []
        taken.append(taken_bytes(lambda: edges.extend(tighten_chain(graph, chain))))  # noqa: B023
        assert edges
    assert abs(taken[1] - taken[0]) < SLACK_BYTES


def test_what_may_close_a_loop_takes_as_much_in_a_large_map_as_in_a_small_one() -> None:
    taken = []
    for nodes in (200, 4_000):
        graph, chain = map_with_a_chain(nodes)
        *saved, before, node = (graph.node(index) for index in chain)
        with LoopSearch(graph, None, None, AcceptanceConfig(), saved=saved) as loops:
            loops._excluded(before)
            taken.append(taken_bytes(lambda: loops._excluded(node)))  # noqa: B023
            excluded = set(loops._excluded(node).tolist())
            assert excluded >= {*range(CHAIN - 8, CHAIN + 7), *chain}
            assert len(excluded) < 3 * CHAIN
    assert abs(taken[1] - taken[0]) < SLACK_BYTES


def test_a_robot_that_stands_on_a_weak_match_keeps_no_more_than_may_be_withdrawn() -> None:
    here = Position.at(make_node(0, 0).id)
    chain = FixChain(sure_confidence=20.0, settle_after_m=10.0)
    chain.begin(0, here, alone=1.0)
    for stamp_ns in range(1, 5_000):
        chain.join(stamp_ns, here, alone=1.0)
        chain.carry_on(SE3.identity(), np.zeros((6, 6)))
    assert chain.on_trial
    assert chain.begin(5_000, here, alone=1.0) == tuple(range(5_000 - MOST_ON_TRIAL, 5_000))


def test_frames_beyond_those_that_may_be_withdrawn_are_saved() -> None:
    written: list[PathEntry | None] = []
    sink = SimpleNamespace(add=lambda _, entry: written.append(entry), checkpoint=lambda: None)
    saver = Saver(sink, path_id(make_node(0, 0).session))
    for index in range(1_000):
        visit = make_node(0, index).id, PathEntryKind.MATCHED
        saver.put(Records(index, visit=visit), MOST_ON_TRIAL)
    assert len(saver._held) == MOST_ON_TRIAL
    Memory(SimpleNamespace(), saver).finish()
    assert not saver._held
    saver.finish()
    assert [entry.sequence for entry in written] == list(range(1_000))
