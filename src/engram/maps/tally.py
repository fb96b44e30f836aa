"""The tally of tags: how many rows they take, and a digest over them.

Tags belong to no revision, whose row counts what it brought: only the tally shows that a tag is
gone with its row.
"""

from __future__ import annotations

import struct

from sqlalchemy import Connection, delete, insert, select

from engram.errors import MapCorruptError
from engram.frontend.blobs import content_digest
from engram.maps.rows import Row, sealed, verified
from engram.maps.schema import tag_tally, tags


def count_tags(connection: Connection) -> None:
    """Writes the tally again; call it in the transaction that changes tags."""
    connection.execute(delete(tag_tally))
    connection.execute(insert(tag_tally), sealed(tag_tally, {"key": 1, **_counted(connection)}))


def check_tally(connection: Connection) -> None:
    """Compares the tally with the tags.

    Raises:
        MapCorruptError: they differ, or there is no tally.
    """
    found = list(verified(tag_tally, connection.execute(select(tag_tally))))
    if len(found) != 1:
        raise MapCorruptError(f"must have one row, not {len(found)}")
    counted = _counted(connection)
    if any(found[0][name] != value for name, value in counted.items()):
        raise MapCorruptError(
            f"counts {found[0]['rows']} rows of tags, and {counted['rows']} others are stored"
        )


def _counted(connection: Connection) -> Row:
    query = select(tags.c.key, tags.c.checksum).order_by(tags.c.key)
    rows = connection.execute(query).fetchall()
    try:
        body = b"".join(struct.pack("<qq", key, checksum) for key, checksum in rows)
    except struct.error as error:  # columns of a damaged file hold anything
        raise MapCorruptError("tags have a key or checksum that is not an integer") from error
    return {"rows": len(rows), "digest": content_digest(body)}
