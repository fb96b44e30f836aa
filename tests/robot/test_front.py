"""Decoding ahead, pacing, driving there and back."""

from collections.abc import Iterator
from itertools import pairwise

import pytest

from engram.robot.front import paced, read_ahead


def test_read_ahead_keeps_order() -> None:
    assert list(read_ahead(range(100), depth=3)) == list(range(100))


def test_read_ahead_raises_where_the_item_would_have_come() -> None:
    def source() -> Iterator[int]:
        yield 1
        raise ValueError("third image")

    items = read_ahead(source(), depth=8)
    assert next(items) == 1
    with pytest.raises(ValueError, match="third image"):
        next(items)


def test_read_ahead_can_be_left_early() -> None:
    produced: list[int] = []

    def source() -> Iterator[int]:
        for number in range(1000):
            produced.append(number)
            yield number

    items = read_ahead(source(), depth=2)
    assert next(items) == 0
    items.close()
    assert len(produced) < 1000


def test_paced_items_arrive_on_schedule_even_for_a_late_consumer() -> None:
    arrivals = [arrived for arrived, _ in paced(range(5), rate_hz=500.0)]
    steps = [b - a for a, b in pairwise(arrivals)]
    assert steps == pytest.approx([0.002] * 4)
