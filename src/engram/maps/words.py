"""Stored words of nodes, so that a large map can be searched without reading its landmarks.

Words follow from a node's landmarks and a vocabulary. They belong to no revision and not to the
content hash. A missing or damaged row only costs the time to compute it again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, select

from engram.errors import InputError, MapCorruptError
from engram.graph.model import NodeId
from engram.maps.database import upsert
from engram.maps.rows import Row, node_from_bytes, sealed, verified
from engram.maps.schema import nodes, words

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


def load_words(connection: Connection, vocabulary: bytes) -> Mapping[NodeId, NDArray[np.int32]]:
    """Words (n,) of each node by the vocabulary of this hash (16 bytes), without damaged rows."""
    query = (
        select(*words.columns, nodes.c.uuid)
        .select_from(words.join(nodes, nodes.c.key == words.c.node))
        .where(words.c.vocabulary == vocabulary)
        .order_by(words.c.node)
    )
    found = {}
    for row in connection.execute(query):
        try:
            kept = next(verified(words, [row]))
            found[node_from_bytes(row[-1])] = decode_words(kept["body"])
        except (MapCorruptError, ValueError):
            continue  # computed again later; `engram check` names the row
    return found
