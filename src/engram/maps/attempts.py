"""Packs remembered match attempts: 18 bytes each, and 8 bytes for each node that occurs.

One body is a MessagePack map: version, base of the iterations, names of the policies, keys of the
nodes, and the packed rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from engram.errors import MapCorruptError

_VERSION = 1
_PACKED = np.dtype(
    [
        ("iteration", "<u2"),  # above the base
        ("reference", "<u2"),  # index into the body's nodes
        ("node", "<u2"),
        ("along_m", "<f2"),  # half precision: 8 mm at 8 m, and infinity
        ("across_m", "<f2"),
        ("yaw_rad", "<f2"),
        ("sigma_m", "u1"),  # `_SIGMA_TABLE`
        ("sigma_yaw_rad", "u1"),
        ("inliers", "<u2"),
        ("rank", "u1"),
        ("flags", "u1"),  # bit 7: accepted; the rest: index into the body's policies
    ]
)
# Code 0 is 0, code c is 2^((c - 1)/12 - 10): 0.001 to 1,900 in steps of 6 %; 255 is unknown.
_SIGMA_TABLE = np.concatenate([[0.0], np.exp2((np.arange(254) / 12) - 10), [np.inf]]).astype(
    np.float32
)
_SIGMA_BORDERS = np.concatenate(
    [[2.0**-10.5], np.exp2((np.arange(253) + 0.5) / 12 - 10), [2.0 ** (253.5 / 12 - 10)]]
)
# Most iterations and nodes of a body; twice as many attempts fill 2.4 MB.
_SPAN = 65536
_ROWS = 131072
_POLICIES = 128

COLUMNS = (
    ("iteration", np.int64),
    ("reference", np.int64),
    ("node", np.int64),
    ("along_m", np.float32),
    ("across_m", np.float32),
    ("yaw_rad", np.float32),
    ("sigma_m", np.float32),
    ("sigma_yaw_rad", np.float32),
    ("accepted", np.bool_),
    ("inliers", np.int32),
    ("rank", np.int32),
)


@dataclass(frozen=True, slots=True, eq=False)
class AttemptTable:
    """Attempts of one session as a struct of arrays, with the keys of nodes (see `Attempt`).

    Attributes:
        columns: (A,) rows with the names, types and units (in the names) of `COLUMNS`.
        policy: (A,) int32, index into `policies`.
        policies: names of the policies.
    """

    columns: dict[str, NDArray[np.generic]]
    policy: NDArray[np.int32]
    policies: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.policy)


class _Body(msgspec.Struct, forbid_unknown_fields=True):
    version: int
    base: int
    policies: list[str]
    nodes: bytes
    rows: bytes


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(_Body)


def concatenate(tables: list[AttemptTable]) -> AttemptTable:
    """All rows in order, with one sorted list of policies."""
    if len(tables) == 1 and tables[0].policies == tuple(sorted(tables[0].policies)):
        return tables[0]
    policies = tuple(sorted({name for table in tables for name in table.policies}))
    index = {name: at for at, name in enumerate(policies)}
    columns = {
        name: np.concatenate([np.empty(0, kind), *(table.columns[name] for table in tables)])
        for name, kind in COLUMNS
    }
    policy = [
        np.array([index[name] for name in table.policies], np.int32)[table.policy]
        for table in tables
        if len(table)
    ]
    return AttemptTable(columns, np.concatenate([np.empty(0, np.int32), *policy]), policies)


def pack(table: AttemptTable) -> list[tuple[int, bytes]]:
    """The bodies of the table, in order, each with its number of attempts."""
    bodies = []
    start = 0
    while start < len(table):
        stop = _body_end(table, start)
        bodies.append((stop - start, _pack_body(table, slice(start, stop))))
        start = stop
    return bodies


def unpack(body: bytes, count: int) -> AttemptTable:
    """The attempts of one body.

    Raises:
        MapCorruptError: the body is malformed or does not hold `count` attempts.
    """
    try:
        content = _decoder.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise MapCorruptError(f"attempts: the packed body is malformed: {error}") from error
    if content.version != _VERSION or len(content.nodes) % 8 or len(content.rows) % 18:
        raise MapCorruptError(
            f"attempts: version {content.version}, {len(content.nodes)} bytes of nodes, "
            f"{len(content.rows)} bytes of rows do not fit version {_VERSION}"
        )
    rows = np.frombuffer(content.rows, _PACKED)
    nodes = np.frombuffer(content.nodes, "<i8").astype(np.int64)
    policy = (rows["flags"] & 127).astype(np.int32)
    ends = np.concatenate([rows["reference"], rows["node"]])
    if (
        len(rows) != count
        or not count
        or ends.max() >= len(nodes)
        or policy.max() >= len(content.policies)
        or abs(content.base) >= 2**62
    ):
        raise MapCorruptError(
            f"attempts: {len(rows)} packed rows, {count} expected, or bad indices"
        )
    return AttemptTable(_columns(rows, nodes, content.base), policy, tuple(content.policies))


def _columns(
    rows: NDArray[np.void], nodes: NDArray[np.int64], base: int
) -> dict[str, NDArray[np.generic]]:
    special = {
        "iteration": rows["iteration"].astype(np.int64) + base,
        "reference": nodes[rows["reference"]],
        "node": nodes[rows["node"]],
        "sigma_m": _SIGMA_TABLE[rows["sigma_m"]],
        "sigma_yaw_rad": _SIGMA_TABLE[rows["sigma_yaw_rad"]],
        "accepted": rows["flags"] >= 128,
    }
    return {
        name: special[name] if name in special else rows[name].astype(kind)
        for name, kind in COLUMNS
    }


def _body_end(table: AttemptTable, start: int) -> int:
    """The longest run from `start` that fits into one body."""
    stop = min(start + _ROWS, len(table))
    while stop - start > 1:
        rows = slice(start, stop)
        iteration = table.columns["iteration"][rows].astype(np.int64)
        nodes = np.concatenate([table.columns["reference"][rows], table.columns["node"][rows]])
        if (
            int(iteration.max() - iteration.min()) < _SPAN
            and len(np.unique(nodes)) <= _SPAN
            and len(np.unique(table.policy[rows])) <= _POLICIES
        ):
            break
        stop = start + (stop - start) // 2
    return stop


def _pack_body(table: AttemptTable, rows: slice) -> bytes:
    columns = {name: values[rows] for name, values in table.columns.items()}
    nodes = np.unique(np.concatenate([columns["reference"], columns["node"]]))
    used, policy = np.unique(table.policy[rows], return_inverse=True)
    # Sorted by name, so that equal attempts give equal bodies.
    policies = sorted(table.policies[at] for at in used)
    policy = np.array([policies.index(table.policies[at]) for at in used])[policy]
    base = int(columns["iteration"].astype(np.int64).min())
    packed = np.empty(len(policy), _PACKED)
    packed["iteration"] = columns["iteration"].astype(np.int64) - base
    for name in ("reference", "node"):
        packed[name] = np.searchsorted(nodes, columns[name])
    with np.errstate(over="ignore"):  # beyond 65,504 m becomes infinity
        for name in ("along_m", "across_m", "yaw_rad"):
            packed[name] = columns[name]
    for name in ("sigma_m", "sigma_yaw_rad"):
        packed[name] = np.searchsorted(_SIGMA_BORDERS, columns[name].astype(np.float64))
    packed["inliers"] = np.clip(columns["inliers"].astype(np.int64), 0, 65535)
    packed["rank"] = np.clip(columns["rank"].astype(np.int64), 0, 255)
    packed["flags"] = policy.astype(np.uint8) | (columns["accepted"].astype(np.uint8) << 7)
    body = _Body(
        version=_VERSION,
        base=base,
        policies=policies,
        nodes=nodes.astype("<i8").tobytes(),
        rows=packed.tobytes(),
    )
    return _encoder.encode(body)
