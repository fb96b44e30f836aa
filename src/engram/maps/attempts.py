"""Stored attempts of drives, and stored words of nodes.

A drive's attempts are packed by the page of the attempted node, so that what past drives say about
a place is read without what they say elsewhere. One body is a MessagePack map: version, base of the
iterations, place of the first attempt, names of the policies, keys of the nodes, and the packed
rows.

Stored words of nodes, so that a large map can be searched without reading its landmarks. Words
follow from a node's landmarks and a vocabulary. They belong to no revision and not to the content
hash. A missing or damaged row only costs the time to compute it again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray
from sqlalchemy import Connection, bindparam, select

from engram.errors import InputError, MapCorruptError
from engram.graph.model import NodeId
from engram.graph.paths import Attempts
from engram.maps.rows import Row, sealed, verified
from engram.maps.schema import nodes, words
from engram.maps.sqlite import SqliteDatabase, upsert

# Node keys of a page of attempts: page p has those from PAGE · p + 1 on.
PAGE = 128

_VERSION = 2
_PACKED = np.dtype(
    [
        ("place", "<u2"),  # among the drive's attempts of this revision, above that of the first
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
# Of maps of format 6: a drive's attempts one after another.
_LAYOUTS = {1: np.dtype([one for one in _PACKED.descr if one[0] != "place"]), _VERSION: _PACKED}
# Code 0 is 0, code c is 2^((c - 1)/12 - 10): 0.001 to 1,900 in steps of 6 %; 255 is unknown.
_SIGMA_TABLE = np.concatenate([[0.0], np.exp2((np.arange(254) / 12) - 10), [np.inf]]).astype(
    np.float32
)
_SIGMA_BORDERS = np.concatenate(
    [[2.0**-10.5], np.exp2((np.arange(253) + 0.5) / 12 - 10), [2.0 ** (253.5 / 12 - 10)]]
)
# Most places, iterations and nodes that a body spans.
_SPAN = 65536
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
    first: int = 0


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(_Body)


def page_of(keys: ArrayLike) -> NDArray[np.int64]:
    """(K,) int64: the page on which attempts at the nodes with these keys, (K,), are stored."""
    return (np.asarray(keys, np.int64) - 1) // PAGE


def pack(table: Attempts, first: int = 0) -> list[Row]:
    """One session's attempts as `page`, `count` and `body` of rows, by page and then in order.

    Args:
        table: `reference` and `node` are keys.
        first: how many attempts of the session the revision has before these.
    """
    pages = page_of(table.node)
    order = np.argsort(pages, kind="stable")
    pages, places, table = pages[order], first + order, table.rows(order)
    return [
        {
            "page": int(pages[start]),
            "count": stop - start,
            "body": _pack_body(table.rows(slice(start, stop)), places[start:stop]),
        }
        for start, stop in _bodies(table, pages, places)
    ]


def unpack(body: bytes, count: int) -> tuple[NDArray[np.int64], Attempts]:
    """The attempts of one body, and their places (count,) among those of session and revision.

    Their `reference` and `node` are keys, `session` is 0.

    Raises:
        MapCorruptError: the body is malformed or does not hold `count` attempts.
    """
    try:
        content = _decoder.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise MapCorruptError(f"attempts: the packed body is malformed: {error}") from error
    layout = _LAYOUTS.get(content.version)
    if layout is None or len(content.nodes) % 8 or len(content.rows) % layout.itemsize:
        raise MapCorruptError(
            f"attempts: version {content.version}, {len(content.nodes)} bytes of nodes, "
            f"{len(content.rows)} bytes of rows do not fit version {_VERSION}"
        )
    rows = np.frombuffer(content.rows, layout)
    nodes = np.frombuffer(content.nodes, "<i8").astype(np.int64)
    policy = (rows["flags"] & 127).astype(np.int32)
    ends = np.concatenate([rows["reference"], rows["node"]])
    if (
        len(rows) != count
        or not count
        or ends.max() >= len(nodes)
        or policy.max() >= len(content.policies)
        or max(abs(content.base), abs(content.first)) >= 2**62
    ):
        raise MapCorruptError(
            f"attempts: {len(rows)} packed rows, {count} expected, or bad indices"
        )
    places = rows["place"] if content.version == _VERSION else np.arange(count)
    return places.astype(np.int64) + content.first, Attempts(
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


def unpack_drive(rows: Sequence[Row]) -> Attempts:
    """The attempts of one session, in the order in which they were made.

    Args:
        rows: of `attempts`, those of earlier revisions first.
    """
    parts = [unpack(row["body"], row["count"]) for row in rows]
    made = Attempts.joined([one for _, one in parts])
    revisions = list(dict.fromkeys(row["revision"] for row in rows))
    ages = [revisions.index(row["revision"]) for row in rows]
    if not parts:
        return made
    places = np.concatenate([one for one, _ in parts])
    return made.rows(np.lexsort((places, np.repeat(ages, [row["count"] for row in rows]))))


def _bodies(
    table: Attempts, pages: NDArray[np.int64], places: NDArray[np.int64]
) -> Iterator[tuple[int, int]]:
    """First and last row, exclusive, of each body of attempts that are sorted by page."""
    ends = [*(np.flatnonzero(np.diff(pages)) + 1).tolist(), len(table)]
    start = 0
    for end in ends:
        while start < end:
            stop = _body_end(table, places, start, end)
            yield start, stop
            start = stop


def _body_end(table: Attempts, places: NDArray[np.int64], start: int, end: int) -> int:
    """The longest run from `start` that fits into one body."""
    stop = end
    while stop - start > 1:
        rows = slice(start, stop)
        nodes = np.concatenate([table.reference[rows], table.node[rows]])
        if (
            np.ptp(table.iteration[rows]) < _SPAN
            and places[stop - 1] - places[start] < _SPAN
            and len(np.unique(nodes)) <= _SPAN
            and len(np.unique(table.policy[rows])) <= _POLICIES
        ):
            break
        stop = start + (stop - start) // 2
    return stop


def _pack_body(made: Attempts, places: NDArray[np.int64]) -> bytes:
    nodes = np.unique(np.concatenate([made.reference, made.node]))
    used, policy = np.unique(made.policy, return_inverse=True)
    # Sorted by name, so that equal attempts give equal bodies.
    policies = sorted(made.policies[at] for at in used)
    policy = np.array([policies.index(made.policies[at]) for at in used])[policy]
    base = int(made.iteration.min())
    packed = np.empty(len(policy), _PACKED)
    packed["place"] = places - places[0]
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
        first=int(places[0]),
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
