"""Remembered attempts, packed: 20 bytes each (SPEC §3.5).

Layout of a packed log, little-endian::

    4 bytes   magic "EATT"
    u8        layout version, 1
    u8        number of policy names P, at most 64
    u32       number of attempts A
    u32       iteration of the first attempt
    P times   u8 length, then that many bytes of UTF-8: a policy's name
    A times   20 bytes:
      u16     iterations since the attempt before (0 for the first)
      u32     key of the reference node
      u32     key of the attempted node
      i16     offset along the node's viewing direction, cm
      i16     offset across it, cm
      i8      yaw, in units of π/127
      u8      σ of the position: 1 cm · 2^(k/16), rounded up
      u8      σ of the yaw: 1 mrad · 2^(k/16), rounded up
      u24     bit 0 accepted, bits 1–10 inliers, bits 11–17 rank, bits 18–23 policy

What lies beyond a field's range is stored as its nearest end (327 m, 1,023 inliers, rank 127).
Nodes are named by keys of whoever stores the log: UUIDs would double its size.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError, MapCorruptError
from engram.graph.model import Attempt, NodeId

_MAGIC = b"EATT"
_VERSION = 1
_HEADER = struct.Struct("<4sBBII")
RECORD = np.dtype(
    [
        ("iterations", "<u2"),
        ("reference", "<u4"),
        ("node", "<u4"),
        ("along", "<i2"),
        ("across", "<i2"),
        ("yaw", "i1"),
        ("sigma", "u1"),
        ("sigma_yaw", "u1"),
        ("flags", "u1", (3,)),
    ]
)
assert RECORD.itemsize == 20

NEAREST_FAILURES = 16
_MAX_POLICIES = 64
_SIGMA_UNIT_M, _SIGMA_UNIT_RAD = 0.01, 0.001


@dataclass(frozen=True, slots=True, eq=False)
class AttemptColumns:
    """Attempts as a struct of arrays, (A,) each, in the order of their iterations.

    Attributes:
        iteration: int64.
        reference, node: int64, keys of the nodes.
        along_m, across_m, yaw_rad, sigma_m, sigma_yaw_rad: float64, as in `Attempt`.
        accepted: bool.
        inliers, rank: int64.
        policy: int64, index into `policies`.
        policies: names of the policies.
    """

    iteration: NDArray[np.int64]
    reference: NDArray[np.int64]
    node: NDArray[np.int64]
    along_m: NDArray[np.float64]
    across_m: NDArray[np.float64]
    yaw_rad: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    sigma_yaw_rad: NDArray[np.float64]
    accepted: NDArray[np.bool_]
    inliers: NDArray[np.int64]
    rank: NDArray[np.int64]
    policy: NDArray[np.int64]
    policies: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.iteration)


class AttemptLog:
    """The attempts of one session, thinned (SPEC §3.5).

    Of each iteration all successes are kept and at most the 16 nearest failures.
    """

    def __init__(self) -> None:
        self._kept: list[Attempt] = []
        self._running: list[Attempt] = []

    def add(self, attempts: Iterable[Attempt]) -> None:
        """Remember attempts of one frame. Iterations must not run backwards.

        Raises:
            InputError: an attempt is of an earlier iteration than the one before it.
        """
        for attempt in attempts:
            if self._running and attempt.iteration != self._running[0].iteration:
                if attempt.iteration < self._running[0].iteration:
                    raise InputError(
                        f"attempt of iteration {attempt.iteration} after one of iteration "
                        f"{self._running[0].iteration}: add them in order"
                    )
                self._kept.extend(_thinned(self._running))
                self._running = []
            self._running.append(attempt)

    @property
    def attempts(self) -> list[Attempt]:
        """All that is kept, in the order of iterations."""
        return [*self._kept, *_thinned(self._running)]

    def take(self) -> list[Attempt]:
        """The attempts of the iterations that are over; they leave the log (for a checkpoint)."""
        taken, self._kept = self._kept, []
        return taken


def pack_attempts(attempts: Sequence[Attempt], key_of: Callable[[NodeId], int]) -> bytes:
    """Pack attempts, in the order of their iterations; see the module's layout.

    Args:
        attempts: of one session.
        key_of: the storage key of a node, from 0 to 2³² - 1.

    Raises:
        InputError: iterations run backwards or leave a gap over 65,535, there are more than 64
            policies, or a key does not fit.
    """
    names = list(dict.fromkeys(attempt.policy for attempt in attempts))
    if len(names) > _MAX_POLICIES:
        raise InputError(f"{len(names)} policies in one log, at most {_MAX_POLICIES}")
    iterations = np.array([a.iteration for a in attempts], np.int64)
    steps = np.diff(iterations, prepend=iterations[:1])
    if len(steps) and not (steps.min() >= 0 and steps.max() <= 0xFFFF):
        raise InputError("iterations of attempts must rise by 0 to 65535 from one to the next")
    records = np.zeros(len(attempts), RECORD)
    records["iterations"] = steps
    records["reference"] = _keys([a.reference for a in attempts], key_of)
    records["node"] = _keys([a.node for a in attempts], key_of)
    records["along"] = _clipped([a.along_m * 100 for a in attempts], "<i2")
    records["across"] = _clipped([a.across_m * 100 for a in attempts], "<i2")
    records["yaw"] = _clipped([a.yaw_rad * 127 / np.pi for a in attempts], "i1")
    records["sigma"] = _sigma_steps([a.sigma_m for a in attempts], _SIGMA_UNIT_M)
    records["sigma_yaw"] = _sigma_steps([a.sigma_yaw_rad for a in attempts], _SIGMA_UNIT_RAD)
    records["flags"] = _flags(attempts, names)
    first = int(iterations[0]) if len(iterations) else 0
    encoded = [name.encode() for name in names]
    table = b"".join(bytes([len(name)]) + name for name in encoded)
    header = _HEADER.pack(_MAGIC, _VERSION, len(names), len(attempts), first)
    return header + table + records.tobytes()


def unpack_attempts(packed: bytes) -> AttemptColumns:
    """Unpack what `pack_attempts` made.

    Raises:
        MapCorruptError: the bytes are something else, cut off, or too long.
    """
    names, first, records = _split(packed)
    flags = records["flags"].astype(np.int64) @ np.array([1, 1 << 8, 1 << 16])
    policy = flags >> 18
    if len(records) and policy.max() >= len(names):
        raise MapCorruptError(
            f"packed attempts: policy {policy.max()} of {len(names)}; restore a copy of the map"
        )
    return AttemptColumns(
        iteration=first + np.cumsum(records["iterations"], dtype=np.int64),
        reference=records["reference"].astype(np.int64),
        node=records["node"].astype(np.int64),
        along_m=records["along"] / 100.0,
        across_m=records["across"] / 100.0,
        yaw_rad=records["yaw"] * (np.pi / 127),
        sigma_m=_SIGMA_UNIT_M * 2.0 ** (records["sigma"] / 16.0),
        sigma_yaw_rad=_SIGMA_UNIT_RAD * 2.0 ** (records["sigma_yaw"] / 16.0),
        accepted=(flags & 1).astype(np.bool_),
        inliers=flags >> 1 & 0x3FF,
        rank=flags >> 11 & 0x7F,
        policy=policy,
        policies=names,
    )


def to_attempts(columns: AttemptColumns, node_of: Callable[[int], NodeId]) -> list[Attempt]:
    """The attempts of unpacked columns; `node_of` undoes the `key_of` they were packed with."""
    c = columns
    rows = zip(
        c.iteration.tolist(), map(node_of, c.reference.tolist()), map(node_of, c.node.tolist()),
        c.along_m.tolist(), c.across_m.tolist(), c.yaw_rad.tolist(), c.sigma_m.tolist(),
        c.sigma_yaw_rad.tolist(), c.accepted.tolist(), c.inliers.tolist(), c.rank.tolist(),
        (c.policies[i] for i in c.policy.tolist()), strict=True,
    )  # fmt: skip
    return [Attempt(*row) for row in rows]


def _thinned(attempts: list[Attempt]) -> list[Attempt]:
    """All successes and the nearest failures, in the order given."""
    failures = [i for i, attempt in enumerate(attempts) if not attempt.accepted]
    failures.sort(key=lambda i: np.hypot(attempts[i].along_m, attempts[i].across_m))
    dropped = set(failures[NEAREST_FAILURES:])
    return [attempt for i, attempt in enumerate(attempts) if i not in dropped]


def _keys(nodes: list[NodeId], key_of: Callable[[NodeId], int]) -> NDArray[np.int64]:
    keys = np.array([key_of(node) for node in nodes], np.int64)
    if len(keys) and not (keys.min() >= 0 and keys.max() <= 0xFFFF_FFFF):
        raise InputError(f"node keys must fit 32 bits; met {keys.min()} to {keys.max()}")
    return keys


def _clipped(values: list[float], dtype: str) -> NDArray[np.float64]:
    limits = np.iinfo(dtype)
    return np.asarray(np.clip(np.rint(values), limits.min, limits.max))


def _sigma_steps(values: list[float], unit: float) -> NDArray[np.float64]:
    """Rounded up: what is read back is never surer than what was written."""
    ratios = np.maximum(np.asarray(values, np.float64) / unit, 1.0)
    # A hair less, so that what was read back packs to the same step again.
    return np.asarray(np.minimum(np.ceil(16 * np.log2(ratios) - 1e-9), 255))


def _flags(attempts: Sequence[Attempt], names: list[str]) -> NDArray[np.uint8]:
    numbers = {name: number for number, name in enumerate(names)}
    flags = np.array(
        [
            a.accepted
            | min(max(a.inliers, 0), 0x3FF) << 1
            | min(max(a.rank, 0), 0x7F) << 11
            | numbers[a.policy] << 18
            for a in attempts
        ],
        np.int64,
    ).reshape(-1, 1)
    return np.asarray(flags >> np.array([0, 8, 16]) & 0xFF, np.uint8)


def _split(packed: bytes) -> tuple[tuple[str, ...], int, NDArray[np.void]]:
    """Policy names, first iteration, records."""
    try:
        magic, version, name_count, count, first = _HEADER.unpack_from(packed)
        if magic != _MAGIC or version != _VERSION:
            raise MapCorruptError("packed attempts: wrong magic or version; restore a copy")
        place, names = _HEADER.size, []
        for _ in range(name_count):
            length = packed[place]
            names.append(packed[place + 1 : place + 1 + length].decode())
            place += 1 + length
    except (struct.error, IndexError, UnicodeDecodeError) as error:
        raise MapCorruptError(
            f"packed attempts: broken header ({error}); restore a copy"
        ) from error
    if len(packed) - place != count * RECORD.itemsize:
        raise MapCorruptError(
            f"packed attempts: {len(packed) - place} bytes for {count} attempts of "
            f"{RECORD.itemsize}; restore a copy of the map"
        )
    return tuple(names), first, np.frombuffer(packed, RECORD, count, place)
