"""Packed attempts: small, and right to what is said of them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engram.errors import MapCorruptError
from engram.graph.paths import Attempts
from engram.maps.attempts import PAGE, pack, unpack, unpack_drive
from engram.maps.rows import Row


def table(
    count: int, seed: int = 0, iterations: int = 2000, nodes: int = 300, apart: int = 1
) -> Attempts:
    rng = np.random.default_rng(seed)
    columns = {
        "iteration": np.sort(rng.integers(0, iterations, count)),
        "reference": rng.integers(1, nodes + 1, count) * 1_000_003,
        "node": rng.integers(1, nodes + 1, count) * apart,
        "along_m": rng.normal(0, 4, count),
        "across_m": rng.normal(0, 1, count),
        "yaw_rad": rng.uniform(-np.pi, np.pi, count),
        "sigma_m": rng.lognormal(-1, 2, count),
        "sigma_yaw_rad": rng.lognormal(-4, 1, count),
        "accepted": rng.random(count) < 0.5,
        "inliers": rng.integers(0, 900, count),
        "rank": rng.integers(0, 255, count),
    }
    kinds = {"accepted": np.bool_, "inliers": np.int32, "rank": np.int32}
    whole = dict.fromkeys(("iteration", "reference", "node"), np.int64)
    return Attempts(
        session=np.zeros(count, np.int32),
        **{
            name: one.astype((kinds | whole).get(name, np.float32)) for name, one in columns.items()
        },
        policy=rng.integers(0, 3, count).astype(np.int32),
        policies=("path", "x", "bandit"),
    )


def unpack_all(bodies: list[Row], revision: int = 1) -> Attempts:
    return unpack_drive([{"revision": revision, **one} for one in bodies])


def assert_close(read: Attempts, written: Attempts) -> None:
    for name in ("iteration", "reference", "node", "accepted", "inliers", "rank"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name), err_msg=name)
    for name in ("along_m", "across_m", "yaw_rad"):  # half precision: 11 bits
        np.testing.assert_allclose(
            getattr(read, name), getattr(written, name), rtol=2**-11, atol=1e-6
        )
    for name in ("sigma_m", "sigma_yaw_rad"):  # steps of 2^(1/12): half of one is 2.93 %
        inside = (getattr(written, name) > 0.001) & (getattr(written, name) < 1900)
        np.testing.assert_allclose(
            getattr(read, name)[inside], getattr(written, name)[inside], rtol=0.0294
        )
    names = [[one.policies[at] for at in one.policy] for one in (read, written)]
    assert names[0] == names[1]


def test_an_attempt_takes_at_most_23_bytes():
    # 8 candidates in each of 500 iterations along 300 nodes.
    bodies = pack(table(4000, iterations=500))
    assert sum(len(one["body"]) for one in bodies) / 4000 < 23


@given(
    count=st.integers(1, 400),
    seed=st.integers(0, 1000),
    apart=st.sampled_from([1, 60, 1_000_003]),
)
@settings(max_examples=30)
def test_attempts_come_back(count, seed, apart):
    written = table(count, seed, apart=apart)
    assert_close(unpack_all(pack(written)), written)


@given(cuts=st.lists(st.integers(0, 300), max_size=4), seed=st.integers(0, 100))
@settings(max_examples=20)
def test_each_body_is_of_one_page_and_the_order_is_that_of_writing(cuts, seed):
    """However many checkpoints wrote them, and in whatever order the bodies are read."""
    written = table(300, seed, apart=9)
    ends = [0, *sorted(cuts), 300]
    bodies = [
        one
        for start, stop in pairwise(ends)
        for one in pack(written.rows(slice(start, stop)), start)
    ]
    for one in bodies:
        _, made = unpack(one["body"], one["count"])
        assert set(((made.node - 1) // PAGE).tolist()) == {one["page"]}
    shuffled = [bodies[at] for at in np.random.default_rng(seed).permutation(len(bodies))]
    assert_close(unpack_all(shuffled), written)


def test_attempts_of_earlier_revisions_come_first():
    early, late = table(50, 1), table(50, 2)
    rows = [{"revision": key, **one} for key, made in ((7, early), (3, late)) for one in pack(made)]
    assert_close(unpack_drive(rows), Attempts.joined([early, late]))


@given(seed=st.integers(0, 100))
@settings(max_examples=10)
def test_packing_what_was_unpacked_changes_nothing(seed):
    bodies = pack(table(200, seed))
    assert pack(unpack_all(bodies)) == bodies


def test_the_order_of_policies_is_of_no_account():
    written = table(200)
    place = [2, 0, 1]
    other = replace(
        written,
        policy=np.argsort(place).astype(np.int32)[written.policy],
        policies=tuple(written.policies[at] for at in place),
    )
    assert_close(other, written)
    assert pack(other) == pack(written)
    assert Attempts.joined([other]).policies == Attempts.joined([written]).policies


def test_long_sessions_are_split_where_indices_end():
    for written in (table(140_000, nodes=100), table(3000, iterations=400_000, nodes=100)):
        bodies = pack(written)
        assert len(bodies) > 1
        assert {one["page"] for one in bodies} == {0}
        assert_close(unpack_all(bodies), written)


def test_what_is_unknown_or_out_of_range_stays_so():
    written = table(4)
    written.along_m[:] = [np.inf, -np.inf, 1e6, -0.0]
    written.sigma_m[:] = [np.inf, 0.0, 1e5, 1e-9]
    written.rank[:] = [255, 300, 70_000, 0]
    written.inliers[:] = [65_535, 65_536, 0, -1]
    read = unpack_all(pack(written))
    np.testing.assert_array_equal(read.along_m, [np.inf, -np.inf, np.inf, 0])
    np.testing.assert_array_equal(read.sigma_m, [np.inf, 0, np.inf, 0])
    np.testing.assert_array_equal(read.rank, [255, 255, 255, 0])
    np.testing.assert_array_equal(read.inliers, [65_535, 65_535, 0, 0])


@given(data=st.data())
def test_hostile_bodies_give_attempts_or_a_clear_error(data):
    (packed,) = pack(table(20, nodes=100))
    count, body = packed["count"], packed["body"]
    broken = bytearray(body)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(broken) - 1))
        broken[at] = data.draw(st.integers(0, 255))
    try:
        _, read = unpack(bytes(broken[: data.draw(st.integers(0, len(broken)))]), count)
    except MapCorruptError:
        return
    assert len(read) == count


def test_another_count_is_refused():
    (packed,) = pack(table(20, nodes=100))
    count, body = packed["count"], packed["body"]
    with pytest.raises(MapCorruptError, match="expected"):
        unpack(body, count + 1)
