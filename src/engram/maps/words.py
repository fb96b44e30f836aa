"""The words of nodes, kept so that a large map can be searched without reading its landmarks.

They follow from a node's landmarks and a vocabulary, and are named by both: no part of history, of
the content hash or of any revision. A row that is missing or damaged costs time, nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, select

from engram.errors import InputError, MapCorruptError
from engram.graph.model import NodeId
from engram.maps.database import Database
from engram.maps.rows import Row, sealed, verified
from engram.maps.schema import nodes, words

_DTYPE = np.dtype("<u2")


def encode_words(found: NDArray[Any]) -> bytes:
    """Words (n,), rising, as they are stored: two bytes each.

    Raises:
        InputError: they do not rise, or there can be no such words.
    """
    wide = np.asarray(found, np.int64)
    if len(wide) and (wide[0] < 0 or wide[-1] > np.iinfo(_DTYPE).max or (np.diff(wide) <= 0).any()):
        raise InputError("the words of a node must rise, from 0 to 65535 at most")
    return wide.astype(_DTYPE).tobytes()


def decode_words(body: bytes) -> NDArray[np.int32]:
    """Undoes `encode_words`.

    Raises:
        MapCorruptError: these are no words.
    """
    if len(body) % _DTYPE.itemsize:
        raise MapCorruptError(f"{len(body)} bytes are no words of two bytes each")
    found = np.frombuffer(body, _DTYPE).astype(np.int32)
    if (np.diff(found) <= 0).any():
        raise MapCorruptError("the words of a node do not rise")
    return found


def words_row(node_key: int, vocabulary: bytes, found: NDArray[Any]) -> Row:
    """The row of one node's words by the vocabulary of this hash."""
    row = {"node": node_key, "vocabulary": vocabulary, "body": encode_words(found)}
    return sealed(words, row)


def write_words(connection: Connection, database: Database, rows: list[Row]) -> None:
    """Keeps words in place of any that the same nodes had by another vocabulary."""
    if rows:
        connection.execute(database.replace(words, ("node",)), rows)


def load_words(connection: Connection, vocabulary: bytes) -> Mapping[NodeId, NDArray[np.int32]]:
    """All that are kept by the vocabulary of this hash; damaged ones are left out."""
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
            found[NodeId(UUID(bytes=row[-1]))] = decode_words(kept["body"])
        except (MapCorruptError, ValueError):
            continue  # they will be worked out again; `engram check` names the row
    return found
