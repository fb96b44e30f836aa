"""Bodies of requests and answers, as the documentation of the API shows them."""

from __future__ import annotations

from typing import Annotated, Any, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, create_model

from engram.fleet.centre import fleet, tables

Hex64 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_HASH = "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08"
_ID = "8c5f1d0e6b0d4b6fa7d5a3b1c2e4f607"


class Body(BaseModel):
    """Unknown fields are errors."""

    model_config = ConfigDict(extra="forbid")


class Enrolment(Body):
    """A robot that enrols: it signs ``engram enrol CODE`` with the key that it names."""

    code: Annotated[str, Field(max_length=100, examples=["q8vJx2mWc1-sT0aZ"])]
    name: Annotated[str, Field(min_length=1, max_length=60, examples=["r1"])]
    public_key: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$", examples=[_HASH])]
    signature: Annotated[str, Field(pattern=r"^[0-9a-f]{128}$", examples=[_HASH * 2])]


class Enrolled(BaseModel):
    """The robot's record at the centre."""

    robot: Annotated[str, Field(examples=[_ID])]
    maps: Annotated[list[str], Field(examples=[["fleet"]])]


class NonceRequest(Body):
    """A robot that wants a token."""

    robot: Annotated[str, Field(max_length=64, examples=[_ID])]


class Nonce(BaseModel):
    """What to sign: ``engram token ROBOT NONCE``."""

    nonce: Annotated[str, Field(examples=[_ID])]


class TokenRequest(NonceRequest):
    """The signed nonce."""

    nonce: Annotated[str, Field(max_length=64, examples=[_ID])]
    signature: Annotated[str, Field(pattern=r"^[0-9a-f]{128}$", examples=[_HASH * 2])]


class Token(BaseModel):
    """Send it as ``Authorization: Bearer TOKEN``."""

    token: Annotated[str, Field(examples=["3vQb0yJ8…"])]
    expires_in_s: Annotated[int, Field(examples=[900])]


class Page(BaseModel):
    """Some of a list; ask again with `next` as cursor until it is null."""

    items: Annotated[list[dict[str, Any]], Field(examples=[[{"number": 42}]])]
    next: Annotated[str | None, Field(examples=["41"])]


class RefMove(Body):
    """The new target of a ref."""

    revision: Annotated[int, Field(ge=1, le=2**53, examples=[7])]


class RevertRequest(Body):
    """A revision whose additions are to be hidden."""

    revision: Annotated[int, Field(ge=1, le=2**53, examples=[7])]
    message: Annotated[str, Field(max_length=500, examples=["wrong clock"])] = ""
    dry_run: bool = False


class DownloadRequest(Body):
    """What a mission needs: the options are those of ``engram download``."""

    ref: Annotated[str, Field(max_length=60, examples=["stable"])] = "head"
    options: Annotated[
        dict[str, Any], Field(examples=[{"select": "tod+paths", "depart_h": 9.5, "arrive_h": 11.0}])
    ] = {}


class Parts(Body):
    """Parts that are wanted, by SHA-256."""

    want: Annotated[list[Hex64], Field(max_length=20_000, examples=[[_HASH]])]


class WirePages(Body):
    """Pages of one table: the first `kept` of the base, then these."""

    kept: Annotated[int, Field(ge=0, le=2**31)] = 0
    pages: Annotated[list[Hex64], Field(max_length=2_000_000, examples=[[_HASH]])] = []


class ManifestBody(Body):
    """What a map consists of; see `engram.fleet.transfers`."""

    format: Annotated[str, Field(max_length=40, examples=["engram-parts-1"])]
    content_hash: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$", examples=[_ID])]
    revision: Annotated[int, Field(ge=0, le=2**53, examples=[2])]
    tables: Annotated[
        dict[str, WirePages], Field(examples=[{"sessions": {"kept": 0, "pages": [_HASH]}}])
    ]
    base: Hex64 | None = None


class RobotReport(Body):
    """What a robot runs, and with which result."""

    runs: Annotated[str | None, Field(max_length=60, examples=["7-18a3f0c2"])] = None
    content_hash: Annotated[str | None, Field(max_length=32, examples=[_ID])] = None
    localised_share: Annotated[float | None, Field(ge=0, le=1, examples=[0.97])] = None
    driven_m: Annotated[float | None, Field(ge=0, le=1e9, examples=[1840.0])] = None
    outbox: Annotated[int, Field(ge=0, le=10**6, examples=[0])] = 0
    told: Annotated[str, Field(max_length=500)] = ""


class Following(Body):
    """A ref to follow, or the number of a revision to be pinned to."""

    follows: Annotated[str, Field(min_length=1, max_length=60, examples=["canary"])]


class CodeRequest(Body):
    """A code with which one robot can enrol."""

    follows: Annotated[str, Field(max_length=60, examples=["head"])] = "head"


class Code(BaseModel):
    """Shown once."""

    code: Annotated[str, Field(examples=["q8vJx2mWc1-sT0aZ"])]


class Open(BaseModel):
    """Has further fields, which depend on the map and the job."""

    model_config = ConfigDict(extra="allow")


class Me(BaseModel):
    """The holder of the token."""

    id: Annotated[str, Field(examples=[_ID])]
    name: Annotated[str, Field(examples=["alice"])]
    roles: Annotated[dict[str, str], Field(examples=[{"fleet": "operator"}])]


class MapCounts(Open):
    """Counts and sizes of a map, as ``engram info --json`` has them."""

    name: Annotated[str, Field(examples=["fleet"])]
    revision: Annotated[int, Field(examples=[7])]
    nodes: Annotated[int, Field(examples=[20_000])]
    size_bytes: Annotated[int, Field(examples=[901_120_000])]
    content_hash: Annotated[str, Field(examples=[_ID])]


class Difference(Open):
    """What changed, as ``engram diff --json`` has it."""

    before: Annotated[int, Field(examples=[6])]
    after: Annotated[int, Field(examples=[7])]
    nodes: Annotated[
        dict[str, int],
        Field(examples=[{"before": 19_950, "after": 20_000, "added": 50, "removed": 0}]),
    ]


class WeakSpots(Open):
    """Weak spots and the drive that would mend most, as ``engram weak-spots --json`` has them."""

    missed: Annotated[float, Field(examples=[0.031])]
    spots: Annotated[
        list[dict[str, Any]],
        Field(examples=[[{"from_m": 120.0, "to_m": 340.0, "hours": [21, 23], "missed": 0.34}]]),
    ]
    advice: Annotated[
        dict[str, Any] | None,
        Field(examples=[{"from_m": 120.0, "to_m": 340.0, "hours": [21, 23], "mends": 0.62}]),
    ]


class Blame(Open):
    """Where a node comes from, as ``engram show NODE --json`` has it."""

    node: Annotated[str, Field(examples=["4188d6f9-03d1-55ee-b0ea-31579aa2d671"])]
    robot: Annotated[str, Field(examples=["r1"])]
    revision: Annotated[int, Field(examples=[7])]


class Reverted(BaseModel):
    """A revision that hides another one; null for a dry run."""

    revision: Annotated[int | None, Field(examples=[8])]
    dry_run: bool
    nodes: Annotated[dict[str, int], Field(examples=[{"before": 20_000, "after": 19_950}])]
    components: Annotated[dict[str, int], Field(examples=[{"before": 1, "after": 2}])]
    lost_by_others: Annotated[dict[str, int], Field(examples=[{"edges": 2}])]


class Job(Open):
    """A hand-in, a download or a dream that waits or runs."""

    kind: Annotated[str, Field(examples=["merge"])]
    id: Annotated[str, Field(examples=[_ID])]
    state: Annotated[str, Field(examples=["complete"])]


class Health(BaseModel):
    """The service answers and reaches its database."""

    status: Annotated[str, Field(examples=["ok"])]
    version: Annotated[str, Field(examples=["0.2.0"])]


class Problem(Open):
    """Problem details of RFC 9457: why a request failed."""

    type: Annotated[str, Field(examples=["about:blank"])]
    title: Annotated[str, Field(examples=["Changed meanwhile"])]
    status: Annotated[int, Field(examples=[412])]
    detail: Annotated[str, Field(examples=["stable is at version 4, not 3: read it again"])]


def _answer(row: type, hidden: tuple[str, ...] = (), **shown: Any) -> type[BaseModel]:
    """A model of the columns of a row that the API shows, each with an example or more."""
    columns: dict[str, Any] = {}
    for name, kind in get_type_hints(row).items():
        if name not in hidden:
            example = shown.get(name, Field())
            is_field = isinstance(example, type(Field()))
            columns[name] = (kind, example if is_field else Field(examples=[example]))
    columns |= {name: more for name, more in shown.items() if name not in columns}
    return create_model(row.__name__, __doc__=row.__doc__, **columns)


MapListed = _answer(tables.MapListed, ("created_ns", "options"), name="fleet", durable_revision=5)
Ref = _answer(tables.Ref, ("map",), name="stable", revision=7, version=3)
Artifact = _answer(
    tables.Artifact,
    ("options", "asked_ns", "used_ns"),
    id=_ID,
    map="fleet",
    revision=7,
    state="ready",
)
HandIn = _answer(
    tables.HandIn,
    ("base", "place", "tries", "cancelled", "ungated"),
    id=_ID,
    map="fleet",
    robot=_ID,
    state="merged",
    wanted=(
        list[str],
        Field(
            [], description="the next parts to send, while the hand-in is open", examples=[[_HASH]]
        ),
    ),
)
Dream = _answer(
    tables.Dream,
    ("since",),
    id=_ID,
    map="fleet",
    state="done",
    revision=Field(description="revision that the dream made, if it found a better map"),
)
RobotListed = _answer(
    fleet.RobotListed,
    robot=_ID,
    map="fleet",
    name="r1",
    follows="stable",
    report={"runs": "7-18a3f0c2", "outbox": 0},
    reported_ns=1_795_589_202_183_444_985,
    disabled=0,
    handins=3,
)
Wanted = _answer(
    fleet.Wanted,
    follows="stable",
    revision=7,
    version=Field(description="version of the revision, never reused", examples=["7-18a3f0c2"]),
    durable_revision=5,
)
