"""The order in which a lost robot goes through a map."""

from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.builders import World, see

from engram.errors import IncompatibleError
from engram.frontend.features import NET
from engram.frontend.frame import BRIEF, Frame, Landmarks
from engram.graph.graph import HalfEdges
from engram.localiser.relocalisation import (
    Exhaustive,
    Relocaliser,
    relocaliser_named,
    spread,
    van_der_corput_order,
)
from engram.places.vocabulary import Vocabulary, default_vocabulary
from engram.places.words import NodeWords
from engram_lab.teblid import TEBLID


@given(st.integers(0, 500))
def test_every_node_comes_once(count: int) -> None:
    assert sorted(van_der_corput_order(count)) == list(range(count))


@given(st.integers(2, 500), st.integers(1, 500))
def test_every_prefix_is_spread_over_the_map(count: int, taken: int) -> None:
    taken = min(taken, count)
    prefix = sorted(van_der_corput_order(count)[:taken])
    widest = max(b - a for a, b in zip([-1, *prefix], [*prefix, count], strict=True))
    # A prefix of k numbers cuts the range into pieces of at most 4/k of its power of two.
    assert widest <= 4 * (1 << (count - 1).bit_length()) / taken + 1


class _Nodes:
    """As many nodes as there are frames; node i is named i."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count

    edge_count = paged = 0

    def ids(self, first: int) -> range:
        return range(first, self.count)

    def holds(self, index: int) -> bool:
        return index < self.count

    def node(self, index: int) -> SimpleNamespace:
        return SimpleNamespace(id=index)

    def half_edges_from(self, nodes: np.ndarray, reach_m: float) -> HalfEdges:
        return HalfEdges.between(np.zeros((0, 2), np.int32), np.zeros((0, 12)), reach_m)


def exhaustive(graph: _Nodes) -> Exhaustive:
    return Exhaustive(graph, None)


def test_exhaustive_goes_through_the_map_over_successive_frames_and_starts_again() -> None:
    graph = _Nodes(5)
    relocaliser = exhaustive(graph)
    proposed = [relocaliser.propose(None, 2, anywhere) for _ in range(3)]
    assert [len(nodes) for nodes in proposed] == [2, 2, 1]
    assert sorted(node for nodes in proposed for node in nodes) == list(range(5))
    graph.count = 6  # a node that joined meanwhile is met in the next pass
    assert 5 in [node for _ in range(3) for node in relocaliser.propose(None, 2, anywhere)]


def test_an_empty_map_proposes_nothing() -> None:
    assert exhaustive(_Nodes(0)).propose(None, 4, anywhere) == []


def anywhere(index: int) -> bool:
    return True


class _Drive:
    """Frames along a road of a synthetic world, as a graph and as a source of landmarks."""

    def __init__(self, places_m: np.ndarray, descriptor=BRIEF) -> None:
        world = World(length_m=float(places_m.max()) + 20, seed=3)
        self.frames = [
            replace(see(world, world.pose_at(s), 1000 + i, count=1500), descriptor=descriptor)
            for i, s in enumerate(places_m)
        ]

    def frame(self, node: int) -> Frame:
        return self.frames[node]


# One place every 8 m, then the same places again, 1.5 m further on.
_PLACES_M = np.arange(0, 400, 8.0)
MAPPED = _Drive(_PLACES_M)
LIVE = _Drive(_PLACES_M + 1.5)


@pytest.mark.parametrize("name", ["fabmap", "bag-of-words"])
def test_a_cold_start_is_proposed_the_right_place_first(name: str) -> None:
    relocaliser = relocaliser_named(name)(*searched(MAPPED))
    first = []
    for live in LIVE.frames:
        relocaliser.forget()
        first.append(relocaliser.propose(live, 1, anywhere))
    # The vocabulary was not made for this world, whose descriptors are random.
    right = [nodes[0] in (i, i + 1) for i, nodes in enumerate(first)]
    assert np.mean(right) > 0.7


def test_a_cold_start_is_proposed_the_right_place_by_its_signature() -> None:
    mapped, live = (_Drive(places_m, NET) for places_m in (_PLACES_M, _PLACES_M + 1.5))
    words = NodeWords(mapped, lambda: default_vocabulary(NET))
    relocaliser = relocaliser_named("signature")(_Nodes(len(_PLACES_M)), words)
    right = []
    for at, frame in enumerate(live.frames):
        relocaliser.forget()
        right.append(relocaliser.propose(frame, 1, anywhere)[0] in (at, at + 1))
    assert np.mean(right) > 0.7


def test_nodes_that_join_the_map_are_proposed_at_once() -> None:
    graph = _Nodes(0)
    relocaliser = relocaliser_named("fabmap")(graph, NodeWords(MAPPED, brief))
    assert relocaliser.propose(LIVE.frames[7], 1, anywhere) == []
    graph.count = 20
    assert relocaliser.propose(LIVE.frames[7], 1, anywhere)[0] in (7, 8)


def test_only_allowed_nodes_are_proposed() -> None:
    relocaliser = relocaliser_named("fabmap")(*searched(MAPPED))
    proposed = relocaliser.propose(LIVE.frames[7], 6, lambda index: index % 3 == 0)
    assert len(proposed) == 6
    assert all(index % 3 == 0 for index in proposed)


def test_what_failed_gives_way_to_places_further_down_the_list() -> None:
    relocaliser = relocaliser_named("fabmap")(*searched(MAPPED))
    proposed = [propose_in_vain(relocaliser) for _ in range(5)]
    assert len({node for nodes in proposed for node in nodes}) == 20


def test_many_attempts_a_frame_go_through_the_whole_map_before_any_is_repeated() -> None:
    one_look = SimpleNamespace(frame=lambda node: MAPPED.frames[0])
    relocaliser = relocaliser_named("fabmap")(_Nodes(600), NodeWords(one_look, brief))
    proposed = [propose_in_vain(relocaliser, 64) for _ in range(9)]
    assert len({node for nodes in proposed for node in nodes}) == 9 * 64


def test_after_it_was_found_the_best_places_come_first_again() -> None:
    relocaliser = relocaliser_named("fabmap")(*searched(MAPPED))
    first, second = (propose_in_vain(relocaliser) for _ in range(2))
    relocaliser.forget()
    assert relocaliser.propose(LIVE.frames[7], 4, anywhere) == first != second


def propose_in_vain(relocaliser: Relocaliser, count: int = 4) -> list[int]:
    proposed = relocaliser.propose(LIVE.frames[7], count, anywhere)
    relocaliser.failed(proposed)
    return proposed


def test_one_frame_asks_for_places_apart_from_each_other() -> None:
    assert spread([10, 11, 9, 40, 12, 70], 3) == [10, 40, 70]
    assert spread([10, 11, 9], 3) == [10, 11, 9]


def test_it_tells_how_likely_a_new_place_is() -> None:
    relocaliser = relocaliser_named("fabmap")(*searched(MAPPED))
    relocaliser.propose(LIVE.frames[7], 4, anywhere)
    assert relocaliser.new_place is not None
    assert relocaliser.new_place < 0.01
    assert exhaustive(_Nodes(3)).new_place is None


def test_a_frame_without_landmarks_is_no_error() -> None:
    frame = LIVE.frames[0]
    none = {f.name: getattr(frame.landmarks, f.name)[:0] for f in fields(frame.landmarks)}
    blind = replace(frame, landmarks=Landmarks(**none))
    assert len(relocaliser_named("fabmap")(*searched(MAPPED)).propose(blind, 4, anywhere)) == 4


def test_a_frame_with_another_kind_of_descriptor_is_refused() -> None:
    relocaliser = relocaliser_named("fabmap")(*searched(MAPPED))
    other = _Drive(np.array([0.0]), TEBLID).frames[0]
    with pytest.raises(IncompatibleError, match="teblid"):
        relocaliser.propose(other, 4, anywhere)


def searched(drive: _Drive) -> tuple:
    return _Nodes(len(drive.frames)), NodeWords(drive, brief)


def brief() -> Vocabulary:
    return default_vocabulary(BRIEF)
