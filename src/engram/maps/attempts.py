"""Stored attempts of drives, and stored words of nodes.

One body is a MessagePack map: version, base of the iterations, names of the policies, keys of the
nodes, and the packed rows.

Stored words of nodes, so that a large map can be searched without reading its landmarks. Words
follow from a node's landmarks and a vocabulary. They belong to no revision and not to the content
hash. A missing or damaged row only costs the time to compute it again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, bindparam, select

from engram.errors import InputError, MapCorruptError
from engram.graph.model import NodeId
from engram.graph.paths import Attempts
from engram.maps.rows import Row, sealed, verified
from engram.maps.schema import nodes, words
from engram.maps.sqlite import SqliteDatabase, upsert

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

# Of `Attempts`, in the order in which the content hash takes them.
COLUMNS = (
    "iteration",
    "reference",
    "node",
    "along_m",
    "across_m",
    "yaw_rad",
    "sigma_m",
    "sigma_yaw_rad",
    "accepted",
    "inliers",
    "rank",
)


class _Body(msgspec.Struct, forbid_unknown_fields=True):
    version: int
    base: int
    policies: list[str]
    nodes: bytes
    rows: bytes


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(_Body)


def pack(table: Attempts) -> list[tuple[int, bytes]]:
    """The bodies of one session's attempts, in order, each with its number of attempts.

    Their `reference` and `node` are keys.
    """
    bodies = []
    start = 0
    while start < len(table):
        stop = _body_end(table, start)
        bodies.append((stop - start, _pack_body(table.rows(slice(start, stop)))))
        start = stop
    return bodies


def unpack(body: bytes, count: int) -> Attempts:
    """The attempts of one body; `reference` and `node` are keys, `session` is 0.

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
    return Attempts(
        session=np.zeros(count, np.int32),
        iteration=rows["iteration"].astype(np.int64) + content.base,
        reference=nodes[rows["reference"]],
        node=nodes[rows["node"]],
        along_m=rows["along_m"].astype(np.float32),
        across_m=rows["across_m"].astype(np.float32),
        yaw_rad=rows["yaw_rad"].astype(np.float32),
        sigma_m=_SIGMA_TABLE[rows["sigma_m"]],
        sigma_yaw_rad=_SIGMA_TABLE[rows["sigma_yaw_rad"]],
        accepted=rows["flags"] >= 128,
        inliers=rows["inliers"].astype(np.int32),
        rank=rows["rank"].astype(np.int32),
        policy=policy,
        policies=tuple(content.policies),
    )


def _body_end(table: Attempts, start: int) -> int:
    """The longest run from `start` that fits into one body."""
    stop = min(start + _ROWS, len(table))
    while stop - start > 1:
        rows = slice(start, stop)
        iteration = table.iteration[rows]
        nodes = np.concatenate([table.reference[rows], table.node[rows]])
        if (
            int(iteration.max() - iteration.min()) < _SPAN
            and len(np.unique(nodes)) <= _SPAN
            and len(np.unique(table.policy[rows])) <= _POLICIES
        ):
            break
        stop = start + (stop - start) // 2
    return stop


def _pack_body(made: Attempts) -> bytes:
    nodes = np.unique(np.concatenate([made.reference, made.node]))
    used, policy = np.unique(made.policy, return_inverse=True)
    # Sorted by name, so that equal attempts give equal bodies.
    policies = sorted(made.policies[at] for at in used)
    policy = np.array([policies.index(made.policies[at]) for at in used])[policy]
    base = int(made.iteration.min())
    packed = np.empty(len(policy), _PACKED)
    packed["iteration"] = made.iteration - base
    for name in ("reference", "node"):
        packed[name] = np.searchsorted(nodes, getattr(made, name))
    with np.errstate(over="ignore"):  # beyond 65,504 m becomes infinity
        for name in ("along_m", "across_m", "yaw_rad"):
            packed[name] = getattr(made, name)
    for name in ("sigma_m", "sigma_yaw_rad"):
        packed[name] = np.searchsorted(_SIGMA_BORDERS, getattr(made, name).astype(np.float64))
    packed["inliers"] = np.clip(made.inliers, 0, 65535)
    packed["rank"] = np.clip(made.rank, 0, 255)
    packed["flags"] = policy.astype(np.uint8) | (made.accepted.astype(np.uint8) << 7)
    body = _Body(
        version=_VERSION,
        base=base,
        policies=policies,
        nodes=nodes.astype("<i8").tobytes(),
        rows=packed.tobytes(),
    )
    return _encoder.encode(body)


_DTYPE = np.dtype("<u2")


def encode_words(found: NDArray[Any]) -> bytes:
    """Encodes words, (n,) increasing numbers without unit, in two bytes each.

    Raises:
        InputError: they do not rise, or are out of range.
    """
    wide = np.asarray(found, np.int64)
    if len(wide) and (wide[0] < 0 or wide[-1] > np.iinfo(_DTYPE).max or (np.diff(wide) <= 0).any()):
        raise InputError("the words of a node must increase, within 0 to 65535")
    return wide.astype(_DTYPE).tobytes()


def decode_words(body: bytes) -> NDArray[np.int32]:
    """Words (n,) int32, rising, from their stored bytes.

    Raises:
        MapCorruptError: the bytes are not valid words.
    """
    if len(body) % _DTYPE.itemsize:
        raise MapCorruptError(f"{len(body)} bytes are not words of two bytes each")
    found = np.frombuffer(body, _DTYPE).astype(np.int32)
    if (np.diff(found) <= 0).any():
        raise MapCorruptError("the words of a node do not increase")
    return found


def words_row(node_key: int, vocabulary: bytes, found: NDArray[Any]) -> Row:
    """The row of one node's words, (n,) numbers, by the vocabulary of this hash (16 bytes)."""
    row = {"node": node_key, "vocabulary": vocabulary, "body": encode_words(found)}
    return sealed(words, row)


def write_words(connection: Connection, rows: list[Row]) -> None:
    """Stores words, replacing those of the same nodes by another vocabulary."""
    if rows:
        connection.execute(upsert(words, ("node",)), rows)


def load_words_between(
    connection: Connection, vocabulary: bytes, first: int, last: int
) -> dict[int, NDArray[np.int32]]:
    """Words (n,) of the nodes with keys `first` to `last`, by key, without damaged rows."""
    query = select(*words.columns).where(
        words.c.vocabulary == vocabulary, words.c.node.between(first, last)
    )
    found = {}
    for row in connection.execute(query):
        sound = _sound_words(row)
        if sound is not None:
            found[row.node] = sound
    return found


def load_words(
    database: SqliteDatabase, vocabulary: bytes, some: Sequence[NodeId]
) -> dict[NodeId, NDArray[np.int32]]:
    """Words (n,) of some nodes by the vocabulary of this hash, without damaged rows."""
    found = {}
    for node in some:
        row = database.first(_WORDS_OF_NODE, {"uuid": node.bytes, "vocabulary": vocabulary})
        sound = None if row is None else _sound_words(row)
        if sound is not None:
            found[node] = sound
    return found


def _sound_words(row: Sequence[Any]) -> NDArray[np.int32] | None:
    try:
        return decode_words(next(verified(words, [row]))["body"])
    except (MapCorruptError, ValueError):
        return None  # computed again later; `engram check` names the row


_WORDS = select(*words.columns, nodes.c.uuid).select_from(
    words.join(nodes, nodes.c.key == words.c.node)
)
_WORDS_OF_NODE = _WORDS.where(
    nodes.c.uuid == bindparam("uuid"), words.c.vocabulary == bindparam("vocabulary")
)
