"""Errors about damaged rows, rows that replace others, and the rows that every map has."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import Connection, Table, delete, insert
from sqlalchemy.dialects.sqlite import Insert
from sqlalchemy.exc import NoResultFound

from engram import __version__
from engram.errors import EngramError, MapCorruptError
from engram.maps.rows import sealed
from engram.maps.schema import FORMAT_VERSION, map_format
from engram.maps.tally import count_tags

_STUMBLES = (TypeError, ValueError, LookupError, ArithmeticError, NoResultFound)


@contextmanager
def damage_named(name: str) -> Iterator[None]:
    """Adds the map's name to errors about damaged rows.

    Args:
        name: path of the map.

    Raises:
        MapCorruptError: as raised within, with the name before it, once.
    """
    try:
        yield
    except MapCorruptError as error:
        if str(error).startswith(name):
            raise
        raise MapCorruptError(f"{name}: {error}") from error


@contextmanager
def reading_rows(name: str) -> Iterator[None]:
    """`damage_named`, where rows become records: what they stumble over is a damaged row.

    Checksums find damage, not what a stranger wrote on purpose: a text of the wrong form, a number
    out of range, a row that refers to none. Whatever such values raise is one error, with its
    cause.

    Args:
        name: path of the map.

    Raises:
        MapCorruptError: a row holds what no map holds.
    """
    with damage_named(name):
        try:
            yield
        except EngramError:
            raise
        except _STUMBLES as error:
            raise MapCorruptError(
                f"a record is malformed ({type(error).__name__}: {error!s:.200}); run "
                "engram check, and restore a copy"
            ) from error


def upsert(table: Table, key: tuple[str, ...]) -> Insert:
    """An insert that replaces a row with the same values in the columns `key`.

    The row takes all other values, including its primary key.
    """
    statement = Insert(table)
    rest = {one.name: one for one in statement.excluded if one.name not in key}
    return statement.on_conflict_do_update(index_elements=list(key), set_=rest)


def write_format(connection: Connection) -> None:
    """Writes the rows that every map has: its format, and the tally of its tags."""
    connection.execute(delete(map_format))
    row = {"key": 1, "version": FORMAT_VERSION, "tool_version": __version__}
    connection.execute(insert(map_format), sealed(map_format, row))
    count_tags(connection)
