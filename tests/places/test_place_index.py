"""The inverted index against a dense table."""

from contextlib import suppress
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engram import _core


@given(st.integers(0, 10_000), st.integers(1, 700))
@settings(max_examples=25)
def test_sums_are_those_of_the_dense_table(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    # Words from common to so rare that gaps take several bytes.
    shown = rng.random((count, 6)) < [0.9, 0.3, 0.1, 0.01, 0.002, 0.0]
    index = _core.PlaceIndex(6)
    for row in shown:
        index.add(np.flatnonzero(row).astype(np.int32))
    weights = rng.normal(size=6)
    sums = np.zeros(count)
    index.add_weights(np.arange(6, dtype=np.int32), weights, sums)
    assert np.allclose(sums, shown @ weights, rtol=0, atol=1e-12)


@given(st.lists(st.integers(-5, 5), max_size=60), st.integers(0, 70))
def test_the_best_come_in_order_and_ties_by_number(scores: list[int], most: int) -> None:
    found = _core.best_scores(np.array(scores, float), most)
    order = sorted(range(len(scores)), key=lambda i: (-scores[i], i))
    assert found.tolist() == order[:most]


def test_places_beyond_the_first_block_are_found() -> None:
    index = _core.PlaceIndex(2)
    count = 2 * _core.PLACES_PER_BLOCK + 300
    often, never = np.array([0], np.int32), np.zeros(0, np.int32)
    for place in range(count):
        index.add(often if place % 777 == 5 else never)
    index.add(np.array([0, 1], np.int32))
    sums = np.zeros(count + 1)
    index.add_weights(np.array([0, 1], np.int32), np.array([1.0, 10.0]), sums)
    expected = (np.arange(count + 1) % 777 == 5).astype(float)
    expected[-1] = 11.0
    assert np.array_equal(sums, expected)


def test_a_place_takes_about_a_byte_per_word() -> None:
    rng = np.random.default_rng(0)
    index = _core.PlaceIndex(1000)
    for _ in range(2000):
        index.add(np.flatnonzero(rng.random(1000) < 0.05).astype(np.int32))
    # 50 words a place; lists hold up to as much in reserve, and each has a head of 24 bytes and 4.
    assert index.bytes < 2000 * 50 * 2 + 1000 * 28 + 100


@pytest.mark.parametrize(
    ("words", "weights", "sums"), [([5], [1.0], 1), ([0], [1.0, 2.0], 1), ([0], [1.0], 2)]
)
def test_what_does_not_fit_is_refused(words, weights, sums) -> None:
    index = _core.PlaceIndex(5)
    index.add(np.array([1], np.int32))
    with pytest.raises(ValueError, match=r"word|sum"):
        index.add_weights(np.array(words, np.int32), np.array(weights), np.zeros(sums))


FULL = _core.PLACES_PER_BLOCK


@cache
def full_block(seed: int) -> tuple[bytes, np.ndarray]:
    """A block, and which of 6 words each of its places shows."""
    rng = np.random.default_rng(seed)
    shown = rng.random((FULL, 6)) < [0.9, 0.3, 0.1, 0.001, 0.0002, 0.0]
    index = _core.PlaceIndex(6)
    for row in shown:
        index.add(np.flatnonzero(row).astype(np.int32))
    assert index.sealed == 1
    return index.block(0), shown


def test_a_stored_block_gives_the_sums_of_the_index() -> None:
    body, shown = full_block(3)
    weights = np.random.default_rng(4).normal(size=6)
    sums = np.zeros(FULL)
    _core.add_block_weights(body, 6, np.arange(6, dtype=np.int32), weights, sums)
    expected = np.zeros(FULL)
    for word in range(6):  # in the order of the words, so that sums are equal to the bit
        expected[shown[:, word]] += weights[word]
    assert np.array_equal(sums, expected)


def test_a_block_that_is_not_full_has_no_bytes() -> None:
    index = _core.PlaceIndex(6)
    index.add(np.array([1], np.int32))
    with pytest.raises(ValueError, match="0 blocks are full"):
        index.block(0)


@given(st.integers(0, 2**32 - 1), st.binary(max_size=40))
@settings(max_examples=200)
def test_no_bytes_lead_out_of_a_block(seed: int, spliced: bytes) -> None:
    body = bytearray(full_block(5)[0])
    rng = np.random.default_rng(seed)
    for byte in spliced:
        body[rng.integers(len(body)) if byte % 2 else rng.integers(24)] = byte
    del body[rng.integers(len(body)) if len(spliced) % 3 == 2 else len(body) :]
    sums = np.zeros(FULL)
    with suppress(ValueError):
        _core.add_block_weights(bytes(body), 6, np.arange(6, dtype=np.int32), np.ones(6), sums)
    assert 0 <= sums.min() <= sums.max() <= 6 * FULL
