"""The log of attempts and its packing."""

import dataclasses
from uuid import UUID

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.errors import InputError, MapCorruptError
from engram.graph.attempts import AttemptLog, pack_attempts, to_attempts, unpack_attempts
from engram.graph.model import Attempt, NodeId


def node_of(key: int) -> NodeId:
    return NodeId(UUID(int=key))


def key_of(node: NodeId) -> int:
    return node.int


def attempt(iteration: int = 0, accepted: bool = False, along_m: float = 1.0) -> Attempt:
    return Attempt(
        iteration, node_of(1), node_of(2), along_m, 0.0, 0.0, 0.1, 0.01, accepted, 5, 0, "path"
    )


metres = st.floats(-300, 300)
attempts_of_any_iteration = st.builds(
    Attempt,
    iteration=st.integers(0, 65_000),
    reference=st.integers(0, 2**32 - 1).map(node_of),
    node=st.integers(0, 2**32 - 1).map(node_of),
    along_m=metres,
    across_m=metres,
    yaw_rad=st.floats(-np.pi, np.pi),
    sigma_m=st.floats(0.01, 100),
    sigma_yaw_rad=st.floats(0.001, 3),
    accepted=st.booleans(),
    inliers=st.integers(0, 1023),
    rank=st.integers(0, 127),
    policy=st.sampled_from(["distance", "path", "Γ"]),
)
logs = st.lists(attempts_of_any_iteration, max_size=20).map(
    lambda log: sorted(log, key=lambda a: a.iteration)
)


@given(logs)
def test_unpacking_gives_what_was_packed_to_the_quantum(log) -> None:
    columns = unpack_attempts(pack_attempts(log, key_of))
    again = to_attempts(columns, node_of)
    assert len(again) == len(log)
    for before, after in zip(log, again, strict=True):
        exact = ("iteration", "reference", "node", "accepted", "inliers", "rank", "policy")
        assert all(getattr(before, name) == getattr(after, name) for name in exact)
        assert after.along_m == pytest.approx(before.along_m, abs=0.0051)
        assert after.across_m == pytest.approx(before.across_m, abs=0.0051)
        assert after.yaw_rad == pytest.approx(before.yaw_rad, abs=np.pi / 253)
        for name in ("sigma_m", "sigma_yaw_rad"):
            # Rounded up by at most a sixteenth of a doubling.
            ratio = getattr(after, name) / getattr(before, name)
            assert 1 - 1e-9 <= ratio <= 2 ** (1 / 16) + 1e-9


@given(logs)
def test_packing_again_what_was_unpacked_changes_no_byte(log) -> None:
    packed = pack_attempts(log, key_of)
    assert pack_attempts(to_attempts(unpack_attempts(packed), node_of), key_of) == packed


def test_an_attempt_takes_twenty_bytes() -> None:
    one, many = (pack_attempts([attempt()] * count, key_of) for count in (1, 1001))
    assert len(many) - len(one) == 20_000


def test_what_is_out_of_range_is_stored_as_the_nearest_end() -> None:
    far = dataclasses.replace(attempt(along_m=1e4), inliers=5000, rank=500, sigma_m=0.0)
    columns = unpack_attempts(pack_attempts([far], key_of))
    assert columns.along_m[0] == 327.67
    assert (columns.inliers[0], columns.rank[0], columns.sigma_m[0]) == (1023, 127, 0.01)


@given(logs, st.data())
def test_damaged_bytes_are_refused_and_never_read_out_of_bounds(log, data) -> None:
    packed = pack_attempts(log, key_of)
    cut = data.draw(st.integers(0, len(packed) - 1))
    with pytest.raises(MapCorruptError):
        unpack_attempts(packed[:cut])
    with pytest.raises(MapCorruptError):
        unpack_attempts(packed + b"\0")
    with pytest.raises(MapCorruptError):
        unpack_attempts(b"X" + packed[1:])


def test_a_policy_that_is_not_in_the_table_is_refused() -> None:
    packed = bytearray(pack_attempts([attempt()], key_of))
    packed[-1] |= 0x80
    with pytest.raises(MapCorruptError, match="policy"):
        unpack_attempts(bytes(packed))


def test_keys_and_iterations_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match="32 bits"):
        pack_attempts([attempt()], lambda _: 2**32)
    for iterations in ([1, 0], [0, 65_536]):
        with pytest.raises(InputError, match="iterations"):
            pack_attempts([attempt(i) for i in iterations], key_of)


def test_log_keeps_all_successes_and_the_sixteen_nearest_failures_of_an_iteration() -> None:
    log = AttemptLog()
    failures = [attempt(0, along_m=float(m)) for m in range(30, 0, -1)]
    successes = [attempt(0, accepted=True, along_m=40.0 + m) for m in range(20)]
    log.add(failures)
    log.add(successes)
    log.add([attempt(1, along_m=99.0)])
    kept = [a for a in log.attempts if a.iteration == 0]
    assert sum(a.accepted for a in kept) == 20
    assert sorted(a.along_m for a in kept if not a.accepted) == [float(m) for m in range(1, 17)]
    assert log.attempts[-1].along_m == 99.0


def test_taking_leaves_the_running_iteration_in_the_log() -> None:
    log = AttemptLog()
    log.add([attempt(0), attempt(1)])
    assert [a.iteration for a in log.take()] == [0]
    assert [a.iteration for a in log.attempts] == [1]


def test_iterations_running_backwards_are_refused() -> None:
    log = AttemptLog()
    log.add([attempt(3)])
    with pytest.raises(InputError, match="iteration 2"):
        log.add([attempt(2)])
