"""Places whose blocks lie in a file are compared as those in memory, to the bit."""

from collections.abc import Callable

import numpy as np
import pytest
from tests.places.worlds import small_vocabulary

from engram.frontend.features import NET
from engram.places.recognisers import PLACES_PER_BLOCK, FabMap, Signatures, StoresBlocks
from engram.places.vocabulary import default_vocabulary

Shown = Callable[[np.random.Generator], np.ndarray]


def some_words(rng: np.random.Generator) -> np.ndarray:
    return np.unique(rng.integers(0, len(VOCABULARY), 12)).astype(np.int32)


def some_signature(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 2**31, Signatures(OF_NET).bytes_per_place // 4).astype(np.int32)


VOCABULARY, OF_NET = small_vocabulary(), default_vocabulary(NET)
KINDS = {
    "fabmap": (FabMap, VOCABULARY, some_words),
    "signature": (Signatures, OF_NET, some_signature),
}


@pytest.mark.parametrize("kind", KINDS)
def test_stored_and_later_places_give_the_same_bits(kind: str) -> None:
    make, vocabulary, shown = KINDS[kind]
    rng = np.random.default_rng(0)
    places = [shown(rng) for _ in range(PLACES_PER_BLOCK + 700)]
    whole = make(vocabulary)
    for place in places:
        whole.add(place)
    assert isinstance(whole, StoresBlocks)
    stored = whole.block(0)
    assert stored.numbers.shape == (whole.rows_of_numbers, PLACES_PER_BLOCK)

    reads: list[int] = []
    opened = make(vocabulary)
    opened.open_blocks(stored.numbers.copy(), lambda number: reads.append(number) or stored.body)
    assert len(opened) == PLACES_PER_BLOCK
    numbers = [opened.add(place) for place in places[PLACES_PER_BLOCK:]]
    assert numbers == list(range(PLACES_PER_BLOCK, len(places)))
    assert opened.stored_as == whole.stored_as

    for query in (places[3], places[-1], shown(rng), np.zeros(0, np.int32)):
        mine, theirs = opened.compare(query), whole.compare(query)
        assert np.array_equal(mine.evidence, theirs.evidence)
        assert mine.new_place == theirs.new_place
    assert opened.recognise(places[5], 1).places.tolist() == [5]
    assert set(reads) == {0}
