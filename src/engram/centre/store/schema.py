"""The service's tables. Times are UTC, ns, by the centre's clock."""

from __future__ import annotations

from typing import Any

from sqlalchemy import (
    BigInteger,
    Column,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Table,
    Text,
)

VERSION = 2

metadata = MetaData()
_INT = BigInteger().with_variant(Integer(), "sqlite")


def _int(name: str, **given: Any) -> Column[int]:
    return Column(name, _INT, nullable=given.pop("nullable", False), **given)


def _text(name: str, **given: Any) -> Column[str]:
    return Column(name, Text(), nullable=given.pop("nullable", False), **given)


def _bytes(name: str, **given: Any) -> Column[bytes]:
    return Column(name, LargeBinary(), nullable=given.pop("nullable", False), **given)


centre = Table("centre", metadata, _int("key", primary_key=True), _int("version"))

maps = Table(
    "maps",
    metadata,
    _text("name", primary_key=True),
    _int("created_ns"),
    _int("durable_revision"),  # the newest that a backup holds
    _text("options"),  # MapPolicy as JSON
)

refs = Table(
    "refs",
    metadata,
    _text("map", primary_key=True),
    _text("name", primary_key=True),
    _int("revision"),
    _int("version"),  # counts its moves: the ETag
    _int("moved_ns"),
    _text("moved_by"),
)

subjects = Table(
    "subjects",
    metadata,
    _text("id", primary_key=True),
    _text("kind"),  # robot or person
    _text("name"),
    _bytes("public_key", nullable=True),
    _int("created_ns"),
    _int("disabled"),
)

grants = Table(
    "grants",
    metadata,
    _text("subject", primary_key=True),
    _text("map", primary_key=True),  # "*" for all
    _text("role"),
)

codes = Table(
    "codes",
    metadata,
    _bytes("hash", primary_key=True),
    _text("map"),
    _text("follows"),
    _int("expires_ns"),
    _text("used_by", nullable=True),
)

nonces = Table(
    "nonces",
    metadata,
    _text("nonce", primary_key=True),
    _text("subject"),
    _int("expires_ns"),
)

tokens = Table(
    "tokens",
    metadata,
    _bytes("hash", primary_key=True),
    _text("subject"),
    _int("expires_ns", nullable=True),
)

robots = Table(  # a robot on a map
    "robots",
    metadata,
    _text("robot", primary_key=True),
    _text("map", primary_key=True),
    _text("follows"),  # a ref, or the number of a revision
    _text("report"),  # the last one, as JSON
    _int("reported_ns", nullable=True),
)

packs = Table(
    "packs",
    metadata,
    _text("id", primary_key=True),
    _text("map"),
    _int("size"),
    _int("written_ns"),
)

parts = Table(
    "parts",
    metadata,
    _text("map", primary_key=True),
    _bytes("hash", primary_key=True),
    _text("pack"),
    _int("start"),
    _int("size"),
)

given = Table(  # by whom a part was handed in: nothing is taken by its hash alone
    "given",
    metadata,
    _text("map", primary_key=True),
    _text("robot", primary_key=True),
    _bytes("hash", primary_key=True),
)

handins = Table(
    "handins",
    metadata,
    _text("id", primary_key=True),
    _text("map"),
    _text("robot"),
    _text("manifest"),
    _text("base", nullable=True),  # the manifest that it continues
    _text("content_hash"),
    _text("state"),
    _int("bytes"),
    _int("begun_ns"),
    _int("place", nullable=True),  # in the order of completion
    _int("ended_ns", nullable=True),
    _int("revision", nullable=True),
    _int("tries"),
    _int("cancelled"),
    _int("ungated"),  # a person merges it whatever the gate says
    _text("progress"),
    _text("report", nullable=True),
    _text("error", nullable=True),
    Index("handins_by_state", "map", "state"),
)

artifacts = Table(
    "artifacts",
    metadata,
    _text("id", primary_key=True),
    _text("map"),
    _int("revision"),
    _text("options"),
    _text("state"),
    _text("manifest", nullable=True),
    _text("report", nullable=True),
    _text("error", nullable=True),
    _int("asked_ns"),
    _int("used_ns"),
    Index("artifacts_by_state", "state"),
)

artifact_grants = Table(
    "artifact_grants",
    metadata,
    _text("artifact", primary_key=True),
    _text("subject", primary_key=True),
)

dreams = Table(  # looks for a better map in what was handed in
    "dreams",
    metadata,
    _text("id", primary_key=True),
    _text("map"),
    _text("state"),
    _text("asked_by"),
    _int("asked_ns"),
    _int("ended_ns", nullable=True),
    _int("since"),  # revision of the fleet map when it was asked for
    _int("revision", nullable=True),  # that it made
    _text("progress"),
    _text("report", nullable=True),
    _text("error", nullable=True),
)

usage = Table(
    "usage",
    metadata,
    _text("subject", primary_key=True),
    _int("day", primary_key=True),
    _int("bytes"),
)

audit = Table(
    "audit",
    metadata,
    Column("number", _INT, primary_key=True, autoincrement=False),
    _int("at_ns"),
    _text("subject"),
    _text("action"),
    _text("map"),
    _text("detail"),
    _text("hash"),  # over the row before and this one
)
