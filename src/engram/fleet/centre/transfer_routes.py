"""Routes: hand-ins, downloads, jobs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

import msgspec
from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse

from engram.errors import InputError
from engram.fleet.centre import downloads, models
from engram.fleet.centre import dreams as dream_jobs
from engram.fleet.centre import handins as handin_jobs
from engram.fleet.centre.access import Role, Subject
from engram.fleet.centre.jobs import cancel as cancel_job
from engram.fleet.centre.jobs import get, pending
from engram.fleet.centre.objects import PACK_BYTES
from engram.fleet.centre.problems import NotAllowedError, QuotaError, UnknownError
from engram.fleet.centre.requests import Asking, CentreHere, page_of, takes
from engram.fleet.centre.routes import Cursor, Limit
from engram.fleet.centre.service import Centre
from engram.fleet.centre.tables import Artifact, Dream, HandIn, values_of
from engram.fleet.transfers import (
    MAX_PART_BYTES,
    PartHash,
    Unbundler,
    WireManifest,
    bundle,
    encode_manifest,
    part_hash,
)

router = APIRouter(tags=["transfers"])
BUNDLE = "application/vnd.engram.bundle"
_BINARY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {BUNDLE: {"schema": {"type": "string", "format": "binary"}}},
    }
}
_KINDS = {HandIn: "merge", Artifact: "download", Dream: "dream"}
_FILE_PIECE = 2**20
# Hashes in one answer: 67 kB, so that a link that breaks often lets it pass.
_WANTED_AT_ONCE = 1_000


@router.post("/maps/{name}/handins", response_model=models.HandIn, dependencies=[takes(Role.ROBOT)])
def begin(name: str, body: models.ManifestBody, centre: CentreHere, who: Asking) -> dict[str, Any]:
    """Begins a hand-in by its manifest, or finds it: the answer says which parts to send."""
    sent = msgspec.convert(body.model_dump(), WireManifest)
    return _with_wanted(centre, handin_jobs.begin(centre, name, who.id, sent))


@router.get("/maps/{name}/handins")
def handins(
    name: str,
    centre: CentreHere,
    who: Asking,
    state: Annotated[str | None, Query(max_length=20)] = None,
    cursor: Cursor = None,
    limit: Limit = 100,
) -> models.Page:
    """Hand-ins, newest first: a robot sees its own."""
    who.check(name, Role.VIEWER, Role.ROBOT)
    robot = who.id if who.role_on(name) is Role.ROBOT else None
    before_ns = 2**62 if cursor is None else cursor
    rows = handin_jobs.listed(centre, name, robot, state, before_ns=before_ns, limit=limit + 1)
    return page_of(list(map(values_of, rows)), limit, "begun_ns")


@router.get("/handins/{handin}", response_model=models.HandIn)
def one_handin(handin: str, centre: CentreHere, who: Asking) -> dict[str, Any]:
    """A hand-in, and its missing parts."""
    return _with_wanted(centre, _handin(centre, who, handin, Role.VIEWER))


@router.put("/handins/{handin}/parts/{part}", status_code=204, openapi_extra=_BINARY)
async def put_part(
    handin: str, part: str, request: Request, centre: CentreHere, who: Asking
) -> None:
    """Sends one part as it is; `part` is its SHA-256."""
    row = await run_in_threadpool(_handin, centre, who, handin)
    body = bytearray()
    async for piece in request.stream():
        body += piece
        if len(body) > MAX_PART_BYTES:
            raise QuotaError(f"the part is larger than {MAX_PART_BYTES} bytes")
    if part_hash(bytes(body)).hex() != part:
        raise InputError("the body does not match its hash; send it again")
    await run_in_threadpool(handin_jobs.put_parts, centre, row, [bytes(body)])


@router.post("/handins/{handin}/parts", response_model=models.HandIn, openapi_extra=_BINARY)
async def put_parts(
    handin: str, request: Request, centre: CentreHere, who: Asking
) -> dict[str, Any]:
    """Sends parts in a bundle. Every megabyte that has arrived stays, even if the rest does not."""
    row, opened = await run_in_threadpool(_handin, centre, who, handin), Unbundler()
    bodies: list[bytes] = []
    try:
        async for piece in request.stream():
            bodies += [body for _, body in opened.feed(piece)]
            if sum(map(len, bodies)) >= PACK_BYTES:
                whole, bodies = bodies, []
                await run_in_threadpool(handin_jobs.put_parts, centre, row, whole)
    finally:
        if bodies:
            await run_in_threadpool(handin_jobs.put_parts, centre, row, bodies)
    return await run_in_threadpool(one_handin, handin, centre, who)


@router.post("/handins/{handin}/complete", response_model=models.HandIn)
def complete(handin: str, centre: CentreHere, who: Asking) -> dict[str, Any]:
    """Hands in: the hand-in becomes a job."""
    return _with_wanted(centre, handin_jobs.complete(centre, _handin(centre, who, handin)))


@router.post("/handins/{handin}/merge", response_model=models.HandIn)
def merge_anyway(handin: str, centre: CentreHere, who: Asking) -> dict[str, Any]:
    """Merges a refused hand-in all the same, without the gate."""
    row = get(centre, HandIn, handin)
    who.check(row.map, Role.OPERATOR)
    return _with_wanted(centre, handin_jobs.merge_anyway(centre, row, who.id))


@router.post("/handins/{handin}/cancel", response_model=models.HandIn)
def cancel(handin: str, centre: CentreHere, who: Asking) -> dict[str, Any]:
    """Ends a hand-in that is not merged yet."""
    row = _handin(centre, who, handin, Role.OPERATOR)
    return _with_wanted(centre, cancel_job(centre, row, who.id))


@router.get("/maps/{name}/jobs", response_model=list[models.Job], dependencies=[takes(Role.VIEWER)])
def jobs(name: str, centre: CentreHere) -> list[dict[str, Any]]:
    """What waits or runs, in its order: hand-ins, then downloads, then dreams."""
    return [_job(row) for kind in (HandIn, Artifact, Dream) for row in pending(centre, kind, name)]


@router.get("/jobs/{job}", response_model=models.Job)
def one_job(job: str, centre: CentreHere, who: Asking) -> dict[str, Any]:
    """A job by the id of its hand-in or artifact."""
    try:
        return _job(_handin(centre, who, job, Role.VIEWER))
    except UnknownError:
        return _job(_granted(centre, who, job))


@router.post(
    "/maps/{name}/dreams", response_model=models.Dream, dependencies=[takes(Role.OPERATOR)]
)
def ask_dream(name: str, centre: CentreHere, who: Asking) -> Dream:
    """Asks for a dream of what is handed in now. Asked again, it is the same dream."""
    return dream_jobs.ask(centre, name, who.id)


@router.get(
    "/maps/{name}/dreams",
    response_model=list[models.Dream],  # type: ignore[valid-type]
    dependencies=[takes(Role.VIEWER)],
)
def dreams(name: str, centre: CentreHere) -> list[Dream]:
    """The last dreams, newest first."""
    return dream_jobs.listed(centre, name)


@router.post("/dreams/{dream}/cancel", response_model=models.Dream)
def cancel_dream(dream: str, centre: CentreHere, who: Asking) -> Dream:
    """Cancels a dream; requested again, it continues where it stopped."""
    row = get(centre, Dream, dream)
    if who.role_on(row.map) is None:
        raise UnknownError(f"there is no dream {dream!r:.40}")
    who.check(row.map, Role.OPERATOR)
    return cancel_job(centre, row, who.id)


@router.post(
    "/maps/{name}/downloads",
    response_model=models.Artifact,
    dependencies=[takes(Role.ROBOT, Role.VIEWER)],
)
def ask_download(
    name: str, body: models.DownloadRequest, centre: CentreHere, who: Asking
) -> Artifact:
    """Asks for what a mission needs. Asked again, it is the same artifact."""
    options = downloads.options_of(body.options)
    return downloads.ask(centre, name, who.id, body.ref, options)


@router.get("/artifacts/{artifact}", response_model=models.Artifact)
def one_artifact(artifact: str, centre: CentreHere, who: Asking) -> Artifact:
    """An artifact, with its forecast."""
    return _granted(centre, who, artifact)


@router.get("/artifacts/{artifact}/manifest")
def artifact_manifest(artifact: str, centre: CentreHere, who: Asking) -> Response:
    """What the artifact consists of. Whoever has some of its pages asks for the others only."""
    body = encode_manifest(downloads.ready(centre, _granted(centre, who, artifact)))
    return Response(body, media_type="application/json")


@router.post(
    "/artifacts/{artifact}/parts",
    responses={200: {"content": {BUNDLE: {"schema": {"type": "string", "format": "binary"}}}}},
)
def artifact_parts(
    artifact: str, body: models.Parts, centre: CentreHere, who: Asking
) -> StreamingResponse:
    """A bundle of the wanted parts, as far as the artifact has them, in their order."""
    wanted = [PartHash(bytes.fromhex(part)) for part in dict.fromkeys(body.want)]
    row = _granted(centre, who, artifact)
    downloads.ready(centre, row)
    return StreamingResponse(bundle(downloads.parts_of(centre, row, wanted)), media_type=BUNDLE)


@router.get("/artifacts/{artifact}/file")
def artifact_file(
    artifact: str, request: Request, centre: CentreHere, who: Asking
) -> StreamingResponse:
    """The whole map file, with ranges, for clients that handle only files."""
    row = _granted(centre, who, artifact)
    downloads.ready(centre, row)
    key = downloads.file_key(row)
    size = centre.objects.size(key)
    start, stop = _range(request.headers.get("range"), size)
    headers = {"Accept-Ranges": "bytes", "Content-Length": str(stop - start)}
    if (start, stop) != (0, size):
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"

    def pieces() -> Iterator[bytes]:
        for at in range(start, stop, _FILE_PIECE):
            yield centre.objects.get(key, at, min(_FILE_PIECE, stop - at))

    status = 206 if "Content-Range" in headers else 200
    return StreamingResponse(
        pieces(), status, headers=headers, media_type="application/vnd.engram.map"
    )


def _range(asked: str | None, size: int) -> tuple[int, int]:
    """First byte and end of the requested range; the whole file if it is missing or invalid."""
    unit, _, span = (asked or "").partition("=")
    first, dash, last = span.partition("-")
    digits = first.isascii() and first.isdecimal() and (not last or last.isdecimal())
    if unit.strip() != "bytes" or not dash or not digits or len(span) > 40:
        return 0, size
    start, stop = int(first), min(int(last) + 1, size) if last else size
    return (start, stop) if start < stop else (0, size)


def _handin(centre: Centre, who: Subject, handin: str, role: Role | None = None) -> HandIn:
    """A hand-in of the robot that asks, or for people with a role on its map.

    Raises:
        UnknownError: there is none, or not for them.
        NotAllowedError: it takes another role.
    """
    row = get(centre, HandIn, handin)
    if row.robot == who.id and who.role_on(row.map) is Role.ROBOT:
        return row
    if who.role_on(row.map) in {None, Role.ROBOT}:
        raise UnknownError(f"there is no hand-in {handin!r:.40}")
    if role is None:
        raise NotAllowedError("only the robot itself may do this")
    who.check(row.map, role)
    return row


def _granted(centre: Centre, who: Subject, artifact: str) -> Artifact:
    """An artifact that the caller requested and may still read.

    Raises:
        UnknownError: there is none, or not for them.
    """
    row = get(centre, Artifact, artifact)
    if who.role_on(row.map) is None or not downloads.is_granted(centre, artifact, who.id):
        raise UnknownError(f"there is no artifact {artifact!r:.40}")
    return row


def _with_wanted(centre: Centre, row: HandIn) -> dict[str, Any]:
    wanted = handin_jobs.wanted_parts(centre, row)[:_WANTED_AT_ONCE]
    return {**values_of(row), "wanted": [part.hex() for part in wanted]}


def _job(row: HandIn | Artifact | Dream) -> dict[str, Any]:
    return {"kind": _KINDS[type(row)], **values_of(row)}
