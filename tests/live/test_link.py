"""The ring of images and the link of messages: what one side writes is what the other reads."""

from __future__ import annotations

import ast
import socket
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engram.live import link as link_module
from engram.live.link import MAGIC, Link, LinkError, Ring


@pytest.fixture
def ring(tmp_path: Path) -> Iterator[Ring]:
    made = Ring.create(str(tmp_path / "ring"), width=10, height=6, slots=3)
    yield made
    made.close()


@pytest.fixture
def ends() -> Iterator[tuple[Link, Link]]:
    here, there = (Link(one) for one in socket.socketpair(socket.AF_UNIX))
    yield here, there
    here.close()
    there.close()


def pair(seed: int) -> tuple[np.ndarray, np.ndarray]:
    left, right = np.random.default_rng(seed).integers(0, 256, (2, 6, 10), np.uint8)
    return left, right


def test_another_process_reads_what_was_written(ring: Ring) -> None:
    reader = Ring.open(ring.path)
    tickets = [ring.write(seed, *pair(seed)) for seed in range(5)]
    for ticket in tickets[-3:]:
        read = reader.read(ticket)
        assert read is not None
        np.testing.assert_array_equal(read, pair(ticket))
    reader.close()


def test_an_overwritten_pair_is_none(ring: Ring) -> None:
    tickets = [ring.write(seed, *pair(seed)) for seed in range(5)]
    assert [ring.read(ticket) is None for ticket in tickets] == [True, True, False, False, False]
    assert ring.read(99) is None
    assert ring.read(-1) is None


def test_a_pair_that_is_being_written_is_none(ring: Ring) -> None:
    ticket = ring.write(0, *pair(0))
    struct.pack_into("<Q", ring._memory, ring._at(ticket), 2 * ticket + 1)
    assert ring.read(ticket) is None


def test_images_of_another_shape_or_type_are_refused(ring: Ring) -> None:
    left, right = pair(0)
    with pytest.raises(LinkError, match=r"\(6, 10\) uint8"):
        ring.write(0, left, right[:, :4])
    with pytest.raises(LinkError, match="float64"):
        ring.write(0, left.astype(float), right)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (b"", "not a ring"),
        (b"SQLite format 3\0" + bytes(100), "not a ring"),
        (struct.pack("<8sIII", MAGIC, 8, 2**31, 2**31), "are not the size of a ring"),
        (struct.pack("<8sIII", MAGIC, 2**32 - 1, 10, 10), "are not the size of a ring"),
        (struct.pack("<8sIII", MAGIC, 8, 640, 480) + bytes(100), "its header asks for"),
    ],
)
def test_files_that_are_no_rings_are_refused(tmp_path: Path, header: bytes, words: str) -> None:
    path = tmp_path / "bad"
    path.write_bytes(header)
    with pytest.raises(LinkError, match=words):
        Ring.open(str(path))


def test_sizes_that_cannot_be_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="are not the size of a ring"):
        Ring.create(str(tmp_path / "ring"), 0, 480)


@settings(max_examples=25)
@given(
    st.lists(
        st.dictionaries(st.text(max_size=5), st.integers() | st.text(max_size=20), max_size=4),
        min_size=1,
        max_size=9,
    )
)
def test_messages_arrive_in_order(messages: list[dict[str, object]]) -> None:
    here, there = (Link(one) for one in socket.socketpair(socket.AF_UNIX))
    for message in messages:
        here.send(message)
    received: list[dict[str, object]] = []
    while len(received) < len(messages):
        received += there.receive(1.0)
    assert received == messages
    here.close()
    there.close()


def test_what_is_no_message_is_refused(ends: tuple[Link, Link]) -> None:
    here, there = ends
    for line, words in ((b"{", "not JSON"), (b"[1]", "not a JSON object"), (b"\xff", "not JSON")):
        here._socket.sendall(line + b"\n")
        with pytest.raises(LinkError, match=words):
            there.receive(1.0)


def test_a_line_without_end_is_refused(ends: tuple[Link, Link]) -> None:
    here, there = ends

    def pour() -> None:
        while True:
            here._socket.sendall(b"x" * 60_000)
            assert there.receive(1.0) == []

    with pytest.raises(LinkError, match="longer than"):
        pour()


def test_a_closed_link_says_so(ends: tuple[Link, Link]) -> None:
    here, there = ends
    here.send({"last": 1})
    here.close()
    assert there.receive(1.0) == [{"last": 1}]
    with pytest.raises(EOFError):
        there.receive(1.0)


def test_it_runs_where_the_middleware_does() -> None:
    """Python 3.8 and NumPy: no import of Engram, no syntax and no builtins of later versions."""
    source = Path(str(link_module.__file__)).read_text()
    tree = ast.parse(source, feature_version=(3, 8))
    imported = {
        name.partition(".")[0]
        for node in ast.walk(tree)
        for name in (
            [one.name for one in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    assert imported - {"numpy", "__future__"} <= set(sys.stdlib_module_names)
    assert "strict=" not in source
