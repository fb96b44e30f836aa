"""The order in which a lost robot goes through a map."""

from hypothesis import given
from hypothesis import strategies as st

from engram.localiser.relocalisation import Exhaustive, van_der_corput_order


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
    def __init__(self, count: int) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count


def test_exhaustive_goes_through_the_map_over_successive_frames_and_starts_again() -> None:
    graph = _Nodes(5)
    relocaliser = Exhaustive(graph)
    proposed = [relocaliser.propose(None, 2) for _ in range(3)]
    assert [len(nodes) for nodes in proposed] == [2, 2, 1]
    assert sorted(node for nodes in proposed for node in nodes) == list(range(5))
    graph.count = 6  # a node that joined meanwhile is met in the next pass
    assert 5 in [node for _ in range(3) for node in relocaliser.propose(None, 2)]


def test_an_empty_map_proposes_nothing() -> None:
    assert Exhaustive(_Nodes(0)).propose(None, 4) == []
