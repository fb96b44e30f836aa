"""The service's tables, each declared by the class of its rows."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from enum import StrEnum
from types import UnionType
from typing import Any, TypeVar, get_args, get_type_hints

from sqlalchemy import (
    BigInteger,
    Column,
    Dialect,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Table,
    Text,
    TypeDecorator,
)
from sqlalchemy.types import TypeEngine

VERSION = 4

metadata = MetaData()
Row = TypeVar("Row")
TABLES: dict[type, Table] = {}


class _Json(TypeDecorator[dict[str, Any]]):
    """Plain data, stored as JSON."""

    impl = Text
    cache_ok = True

    def process_bind_param(self, value: Any, dialect: Dialect) -> str | None:
        del dialect
        return None if value is None else json.dumps(value)

    def process_result_value(self, value: Any, dialect: Dialect) -> Any:
        del dialect
        return None if value is None else json.loads(value)


_TYPES: dict[Any, TypeEngine[Any]] = {
    str: Text(),
    int: BigInteger().with_variant(Integer(), "sqlite"),
    bytes: LargeBinary(),
    dict[str, Any]: _Json(),
}


def _table(name: str, row: type, *key: str, index: tuple[str, ...] = ()) -> Table:
    """The table of a class of rows: a column for each field, by its type."""
    columns = []
    for field, hint in get_type_hints(row).items():
        known = [part for part in get_args(hint) if part is not type(None)]
        kind = known[0] if isinstance(hint, UnionType) else hint
        column: Column[Any] = Column(
            field,
            _TYPES[kind],
            primary_key=field in key,
            nullable=isinstance(hint, UnionType),
            autoincrement=False,
        )
        columns.append(column)
    indexes = [Index(f"{name}_by_state", *index)] if index else []
    TABLES[row] = Table(name, metadata, *columns, *indexes)
    return TABLES[row]


def values_of(row: object) -> dict[str, Any]:
    """The columns of a row by name."""
    return {column.name: getattr(row, column.name) for column in fields(row)}  # type: ignore[arg-type]


class JobState(StrEnum):
    """State of a hand-in, a download or a dream."""

    OPEN = "open"  # a hand-in: parts are missing
    COMPLETE = "complete"  # a hand-in: waits for a worker, or a worker merges it
    ASKED = "asked"  # a download or dream: waits for a worker, or a worker makes it
    MERGED = "merged"
    READY = "ready"
    DONE = "done"
    REFUSED = "refused"  # a hand-in, by the gate; a person may merge it anyway
    FAILED = "failed"
    CANCELLED = "cancelled"


ENDED = frozenset(JobState) - {JobState.OPEN, JobState.COMPLETE, JobState.ASKED}


@dataclass(frozen=True, slots=True)
class Schema:
    """The version of the tables."""

    key: int
    version: int


@dataclass(frozen=True, slots=True)
class MapListed:
    """A map that the caller may read."""

    name: str
    created_ns: int
    durable_revision: int  # the newest that a backup holds
    options: dict[str, Any]  # MapPolicy


@dataclass(frozen=True, slots=True)
class Published:
    """What a map holds of which workers keep copies: its manifest lies among the objects."""

    map: str
    revision: int
    stamp: str  # of the file at this revision
    content_hash: str
    manifest: str  # id of this publication


@dataclass(frozen=True, slots=True)
class Ref:
    """A ref. The version is its ETag."""

    map: str
    name: str
    revision: int
    version: int  # counts its moves
    moved_ns: int
    moved_by: str


@dataclass(frozen=True, slots=True)
class Account:
    """A robot or person."""

    id: str
    kind: str  # robot or person
    name: str
    public_key: bytes | None
    created_ns: int
    disabled: int


@dataclass(frozen=True, slots=True)
class Grant:
    """A role on a map."""

    subject: str
    map: str  # "*" for all
    role: str


@dataclass(frozen=True, slots=True)
class EnrolmentCode:
    """A code with which one robot enrols."""

    hash: bytes
    map: str
    follows: str
    expires_ns: int
    used_by: str | None


@dataclass(frozen=True, slots=True)
class Nonce:
    """A nonce that a robot is to sign."""

    nonce: str
    subject: str
    expires_ns: int


@dataclass(frozen=True, slots=True)
class Token:
    """A token, by its hash."""

    hash: bytes
    subject: str
    expires_ns: int | None


@dataclass(frozen=True, slots=True)
class RobotOnMap:
    """A robot on a map."""

    robot: str
    map: str
    follows: str  # a ref, or the number of a revision
    report: dict[str, Any]  # the last one
    reported_ns: int | None


@dataclass(frozen=True, slots=True)
class Pack:
    """An object that holds parts of a map."""

    id: str
    map: str
    size: int
    written_ns: int


@dataclass(frozen=True, slots=True)
class PackedPart:
    """Where a part is: a range of a pack."""

    map: str
    hash: bytes
    pack: str
    start: int
    size: int


@dataclass(frozen=True, slots=True)
class GivenPart:
    """A robot handed in a part: the hash alone gives access to none."""

    map: str
    robot: str
    hash: bytes


@dataclass(frozen=True, slots=True)
class HandIn:
    """A hand-in: also the job that merges it."""

    id: str
    map: str
    robot: str
    manifest: str
    base: str | None  # the manifest that it continues
    content_hash: str
    state: str
    bytes: int
    begun_ns: int
    place: int | None = None  # in the order of completion
    ended_ns: int | None = None
    revision: int | None = None
    tries: int = 0
    cancelled: int = 0
    ungated: int = 0  # merged without the gate, as a person decided
    progress: str = ""
    report: dict[str, Any] | None = None
    error: str | None = None


@dataclass(frozen=True, slots=True)
class Artifact:
    """A download; `report` has the forecast once it is ready."""

    id: str
    map: str
    revision: int
    options: dict[str, Any]
    state: str
    asked_ns: int
    used_ns: int
    manifest: str | None = None
    report: dict[str, Any] | None = None
    error: str | None = None


@dataclass(frozen=True, slots=True)
class ArtifactGrant:
    """A person or robot requested an artifact."""

    artifact: str
    subject: str


@dataclass(frozen=True, slots=True)
class Dream:
    """A job that looks for a better map in what was handed in; `report` once it is done."""

    id: str
    map: str
    state: str
    asked_by: str
    asked_ns: int
    since: int  # revision of the fleet map when it was requested
    ended_ns: int | None = None
    revision: int | None = None  # that it made
    progress: str = ""
    report: dict[str, Any] | None = None
    error: str | None = None


@dataclass(frozen=True, slots=True)
class Usage:
    """Bytes that a robot handed in on a day."""

    subject: str
    day: int
    bytes: int


@dataclass(frozen=True, slots=True)
class Event:
    """A row of the audit log."""

    number: int
    at_ns: int
    subject: str
    action: str
    map: str
    detail: str  # JSON, as it is hashed
    hash: str  # over the row before and this one


centre = _table("centre", Schema, "key")
maps = _table("maps", MapListed, "name")
published = _table("published", Published, "map")
refs = _table("refs", Ref, "map", "name")
subjects = _table("subjects", Account, "id")
grants = _table("grants", Grant, "subject", "map")
codes = _table("codes", EnrolmentCode, "hash")
nonces = _table("nonces", Nonce, "nonce")
tokens = _table("tokens", Token, "hash")
robots = _table("robots", RobotOnMap, "robot", "map")
packs = _table("packs", Pack, "id")
parts = _table("parts", PackedPart, "map", "hash")
given = _table("given", GivenPart, "map", "robot", "hash")
handins = _table("handins", HandIn, "id", index=("map", "state"))
artifacts = _table("artifacts", Artifact, "id", index=("state",))
artifact_grants = _table("artifact_grants", ArtifactGrant, "artifact", "subject")
dreams = _table("dreams", Dream, "id")
usage = _table("usage", Usage, "subject", "day")
audit = _table("audit", Event, "number")
