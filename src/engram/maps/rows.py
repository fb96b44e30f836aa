"""Converts records to rows and back, with a checksum for each row.

The tally of tags: how many rows they take, and a digest over them. Tags belong to no revision,
whose row counts what it brought: only the tally shows that a tag is gone with its row.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from functools import cache
from itertools import product
from typing import Any, TypeVar
from uuid import UUID

import msgspec
import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Table, delete, insert, select

from engram.errors import CalibrationError, InputError, MapCorruptError
from engram.frontend.blobs import content_digest
from engram.geometry.cameras import CameraId, StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.clock import is_zone_name
from engram.graph.model import (
    LONGEST_NAME,
    Amendable,
    Amendment,
    Clock,
    Edge,
    EdgeKind,
    Node,
    NodeId,
    Session,
    SessionId,
)
from engram.maps.schema import tag_tally, tags

Row = dict[str, Any]
_Kind = TypeVar("_Kind", bound=StrEnum)

START = re.compile(r"-?\d{1,19}")  # ns, as text
_UPPER = np.triu_indices(6)
_encode = msgspec.msgpack.Encoder().encode

# Asymmetry of covariances by rounding, since they come from products with transposes.
_ASYMMETRY_LIMIT = 1e-6


def checksum(values: Sequence[Any]) -> int:
    """CRC-32 of a row's columns (all but the checksum) as a MessagePack array.

    It detects damage, not manipulation; landmark blobs have a cryptographic hash.
    """
    return zlib.crc32(_encode(values))


def sealed(table: Table, values: Row) -> Row:
    """The row with its checksum."""
    names, _ = _shape(table)
    values["checksum"] = checksum([values[name] for name in names[:-1]])
    return values


def verified(table: Table, rows: Iterable[Sequence[Any]]) -> Iterator[Row]:
    """Rows of one table as dicts, each checked against its checksum; see `verified_values`."""
    names, _ = _shape(table)
    for values in verified_values(table, rows):
        yield dict(zip(names, values, strict=True))


def verified_values(table: Table, rows: Iterable[Sequence[Any]]) -> Iterator[Sequence[Any]]:
    """Rows of one table, each checked against its checksum: the values of its columns.

    Args:
        table: the rows begin with all its columns, in order; further columns are dropped.
        rows: from a select.

    Raises:
        MapCorruptError: a checksum does not match; names table and row.
    """
    names, kinds = _shape(table)
    count = len(names)
    for row in rows:
        values = row[:count]
        if checksum(values[:-1]) != values[-1] or tuple(map(type, values)) not in kinds:
            raise mismatch(table, values)
        yield values


def mismatch(table: Table, values: Sequence[Any]) -> MapCorruptError:
    """The error of a row that does not match its checksum."""
    return MapCorruptError(
        f"table {table.name}: {describe(table, values)} does not match its checksum; "
        "run engram check, and restore a copy"
    )


@cache
def _shape(table: Table) -> tuple[list[str], set[tuple[type, ...]]]:
    """Names of a table's columns, and the allowed types of their values."""
    kinds = product(
        *(
            (column.type.python_type, *([type(None)] if column.nullable else []))
            for column in table.columns
        )
    )
    return [column.name for column in table.columns], set(kinds)


def describe(table: Table, values: Sequence[Any]) -> str:
    """Name of a row in messages: its UUID if it has one, else its key."""
    named = dict(zip((column.name for column in table.columns), values, strict=False))
    if isinstance(named.get("uuid"), bytes) and len(named["uuid"]) == 16:
        return str(UUID(bytes=named["uuid"]))
    if "id" in named:
        return str(named["id"])
    return f"row {next(iter(values), '?')}"


def to_json(values: Mapping[str, Any]) -> str:
    """Canonical JSON text: equal values give equal text.

    Raises:
        InputError: a value is not plain data, or not finite.
    """
    try:
        return json.dumps(dict(values), sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(f"cannot be stored as JSON: {error}") from error


def from_json(text: str, what: str) -> dict[str, Any]:
    """Undoes `to_json`."""
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MapCorruptError(f"{what} is not valid JSON: {error}") from error
    if not isinstance(values, dict):
        raise MapCorruptError(f"{what} is not a JSON object")
    return values


def checked_text(value: str, what: str) -> str:
    """Checks a text for all supported databases.

    Raises:
        InputError: it is not valid Unicode, or holds a zero character.
    """
    try:
        value.encode()
    except UnicodeEncodeError as error:
        raise InputError(f"{what} {value!r} is not valid Unicode") from error
    if "\0" in value:
        raise InputError(f"{what} {value!r} holds a zero character")
    return value


def checked_int(value: int, what: str) -> int:
    """Checks an integer of 64 bits.

    Raises:
        InputError: it needs more bits.
    """
    if not -(2**63) <= value < 2**63:
        raise InputError(f"{what} is {value}, must fit into 64 bits")
    return int(value)


def transform_bytes(target_from_source: SE3) -> bytes:
    """96 bytes: rotation row by row, then translation, little-endian float64."""
    return _floats(
        np.concatenate([target_from_source.rotation.ravel(), target_from_source.translation])
    )


def transform_from_bytes(data: bytes, what: str) -> SE3:
    """Inverse of `transform_bytes`, bit for bit."""
    (values,) = _arrays([data], 12, lambda _: what)
    return SE3(values[:9].reshape(3, 3), values[9:])


def transforms_from_bytes(data: NDArray[np.uint8], named: Callable[[int], str]) -> list[SE3]:
    """Inverse of `transform_bytes` for (N, 96) of them; `named` gives a row's name for messages."""
    values = _finite(data, named)
    rotations, translations = values[:, :9].reshape(-1, 3, 3), values[:, 9:]
    return [SE3(*both) for both in zip(rotations, translations, strict=True)]


# Side of a cell of the map frame, metres, and how many of them lie on each side of the origin.
CELL_M = 32.0
_HALF = 2**30


def cell_at(x_m: float, y_m: float) -> int:
    """Number of the cell at a place of the map frame; neighbours along y have successive ones.

    What lies beyond 2³⁵ m counts as at the border.
    """
    along, across = (
        int(np.clip(np.floor(value_m / CELL_M), -_HALF, _HALF)) + _HALF for value_m in (x_m, y_m)
    )
    return (along << 32) + across


def cell_of(map_from_node: SE3) -> int:
    """Number of the cell in which a node lies."""
    return cell_at(*map_from_node.translation[:2].tolist())


def covariance_bytes(covariance: NDArray[np.float64]) -> bytes:
    """168 bytes: upper triangle of a (6, 6) covariance (m, rad), row by row, little-endian."""
    return _floats(covariance[_UPPER])


def uuid_from_bytes(data: bytes, what: str) -> UUID:
    """A UUID from its 16 bytes."""
    try:
        return UUID(bytes=data)
    except (ValueError, TypeError) as error:
        raise MapCorruptError(f"{what} has no UUID of 16 bytes: {error}") from error


def node_from_bytes(data: bytes) -> NodeId:
    """The id of a node from its 16 bytes."""
    return NodeId(uuid_from_bytes(data, "a node"))


def camera_row(camera: StereoCamera, key: int) -> Row:
    """Columns of `cameras`."""
    mounting = camera.cam_from_rig
    return {
        "key": key,
        "id": camera.id,
        **{name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy", "baseline_m")},
        "width": int(camera.width),
        "height": int(camera.height),
        "cam_from_rig": None if mounting is None else transform_bytes(mounting),
        "rectification": checked_text(camera.rectification, "rectification"),
    }


def camera_from_row(row: Row) -> StereoCamera:
    """The camera; its id must match the hash of the other columns."""
    what = f"camera {row['id']}"
    mounting = row["cam_from_rig"]
    try:
        camera = StereoCamera(
            **{name: row[name] for name in ("fx", "fy", "cx", "cy", "baseline_m")},
            width=row["width"],
            height=row["height"],
            cam_from_rig=None if mounting is None else transform_from_bytes(mounting, what),
            rectification=row["rectification"],
        )
    except (CalibrationError, TypeError) as error:
        raise MapCorruptError(f"{what}: {error}") from error
    if camera.id != row["id"]:
        raise MapCorruptError(f"{what}: its values belong to camera {camera.id}")
    return camera


def session_row(session: Session, key: int, revision: int, camera: int, frontend: int) -> Row:
    """Columns of `sessions`: as recorded, without amendments."""
    session = session.as_recorded
    return {
        "key": key,
        "uuid": session.id.bytes,
        "revision": revision,
        "robot": checked_text(session.robot, "robot"),
        "camera": camera,
        "frontend": frontend,
        "start_ns": checked_int(session.start_ns, "start_ns"),
        "clock": str(session.clock),
        "longitude_deg": None if session.longitude_deg is None else float(session.longitude_deg),
        "zone": None if session.zone is None else checked_text(session.zone, "zone"),
    }


def session_from_row(row: Row, camera: CameraId) -> Session:
    """The session."""
    return Session(
        id=SessionId(uuid_from_bytes(row["uuid"], f"session {row['key']}")),
        robot=_robot_name(row["robot"]),
        camera=camera,
        start_ns=row["start_ns"],
        clock=member(Clock, row["clock"], "sessions"),
        longitude_deg=_longitude(row["longitude_deg"]),
        zone=None if row["zone"] is None else _zone_name(row["zone"]),
    )


def _robot_name(text: str) -> str:
    """The name of a robot.

    Raises:
        MapCorruptError: Engram stores no such value.
    """
    if not 0 < len(text) <= LONGEST_NAME:
        raise MapCorruptError(
            f"table sessions: a robot's name has {len(text)} characters, must have 1 to "
            f"{LONGEST_NAME}"
        )
    return text


def _longitude(longitude_deg: float | None) -> float | None:
    """Degrees east.

    Raises:
        MapCorruptError: no place has it.
    """
    if longitude_deg is not None and not -180 <= longitude_deg <= 180:
        raise MapCorruptError(f"table sessions: the longitude is {longitude_deg} degrees")
    return longitude_deg


def _zone_name(text: str) -> str:
    """The name of a time zone, perhaps only in a newer database than this machine's.

    Raises:
        MapCorruptError: it can name none.
    """
    if not is_zone_name(text):
        raise MapCorruptError(f"table sessions: {text!r:.60} is not the name of a time zone")
    return text


def amendment_from_row(row: Row, session: SessionId) -> Amendment:
    """The amendment of this session."""
    what = member(Amendable, row["what"], "amendments")
    if what is Amendable.START and not START.fullmatch(row["value"]):
        raise MapCorruptError(f"amendment of session {session}: {row['value']!r:.60} is not a time")
    if what is Amendable.ZONE:
        _zone_name(row["value"])
    if what is Amendable.ROBOT:
        _robot_name(row["value"])
    return Amendment(session, what, row["value"], row["amended_ns"])


def node_from_row(row: Row, session: SessionId, camera: CameraId) -> Node:
    """The node."""
    return Node(
        id=NodeId(uuid_from_bytes(row["uuid"], f"node {row['key']}")),
        session=session,
        stamp_ns=row["stamp_ns"],
        camera=camera,
        driven_m=row["driven_m"],
    )


def edge_row(edge: Edge, key: int, revision: int, a: int, b: int) -> Row:
    """Columns of `edges`."""
    return {
        "key": key,
        "revision": revision,
        "a": a,
        "b": b,
        "kind": str(edge.kind),
        "a_from_b": transform_bytes(edge.a_from_b),
        "covariance": covariance_bytes(edge.covariance),
    }


def edges_from_rows(rows: Sequence[Row], ends: Sequence[tuple[NodeId, NodeId]]) -> tuple[Edge, ...]:
    """The edges, each with its ends (a, b)."""

    def named(at: int) -> str:
        return f"edge {ends[at][0]} {ends[at][1]} {rows[at]['kind']}"

    transforms = _arrays([row["a_from_b"] for row in rows], 12, named)
    covariances = _symmetric(_arrays([row["covariance"] for row in rows], 21, named))
    rotations, translations = transforms[:, :9].reshape(-1, 3, 3), transforms[:, 9:]
    return tuple(
        Edge(
            a=a,
            b=b,
            kind=member(EdgeKind, row["kind"], "edges"),
            a_from_b=SE3(rotations[at], translations[at]),
            covariance=covariances[at],
        )
        for at, (row, (a, b)) in enumerate(zip(rows, ends, strict=True))
    )


def edge_arrays(
    transforms: NDArray[np.uint8], covariances: NDArray[np.uint8], keys: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Transforms (E, 12) and covariances (E, 6, 6) from their bytes.

    Args:
        transforms: (E, 96) uint8, see `transform_bytes`.
        covariances: (E, 168) uint8, see `covariance_bytes`.
        keys: (E,) of the rows, for messages.
    """
    parts = [_finite(one, lambda at: f"edge {keys[at]}") for one in (transforms, covariances)]
    return parts[0], _symmetric(parts[1])


def _symmetric(halves: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 6, 6) of their upper triangles (N, 21)."""
    whole = np.empty((len(halves), 6, 6))
    whole[:, _UPPER[0], _UPPER[1]] = halves
    whole[:, _UPPER[1], _UPPER[0]] = halves
    return whole


def member(kind: type[_Kind], value: str, table: str) -> _Kind:
    """The member of an enumeration with this text.

    Raises:
        MapCorruptError: there is none; names the table.
    """
    found: _Kind | None = _members(kind).get(value)
    if found is None:
        raise MapCorruptError(f"table {table}: {value!r} is not a valid {kind.__name__}")
    return found


@cache
def _members(kind: type[_Kind]) -> dict[str, _Kind]:
    """Members by their text: ten times faster than calling the enum."""
    return {str(one): one for one in kind}


def _floats(values: NDArray[np.float64]) -> bytes:
    return np.ascontiguousarray(values, dtype="<f8").tobytes()


def _arrays(parts: Sequence[bytes], count: int, named: Callable[[int], str]) -> NDArray[np.float64]:
    """(N, count) float64 of N rows; `named` gives the name of a row for messages."""
    for at, data in enumerate(parts):
        if len(data) != 8 * count:
            raise MapCorruptError(
                f"{named(at)}: {count} numbers take {8 * count} bytes, not {data!r:.40}"
            )
    whole = np.frombuffer(b"".join(parts), np.uint8).reshape(-1, 8 * count)
    return _finite(whole, named)


def _finite(data: NDArray[np.uint8], named: Callable[[int], str]) -> NDArray[np.float64]:
    """(N, K) float64 of (N, 8 K) bytes."""
    values = data.view("<f8").astype(np.float64)
    infinite = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if infinite.size:
        raise MapCorruptError(f"{named(int(infinite[0]))}: holds numbers that are not finite")
    return values


def check_edge(edge: Edge) -> None:
    """Refuse an edge that no map should hold.

    Raises:
        InputError: it joins a node with itself, or its numbers are not finite and symmetric.
    """
    what = f"edge {edge.a} → {edge.b} ({edge.kind})"
    if edge.a == edge.b:
        raise InputError(f"{what} joins a node with itself")
    transform = np.concatenate([edge.a_from_b.rotation.ravel(), edge.a_from_b.translation])
    if not np.isfinite(transform).all() or edge.covariance.shape != (6, 6):
        raise InputError(f"{what}: a transform is finite, its covariance (6, 6)")
    asymmetry = np.abs(edge.covariance - edge.covariance.T).max()
    if not asymmetry <= _ASYMMETRY_LIMIT * max(1.0, np.abs(edge.covariance).max()):
        raise InputError(f"{what}: its covariance is not finite and symmetric")


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
