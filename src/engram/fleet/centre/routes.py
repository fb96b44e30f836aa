"""Routes: maps, history, refs, reverts, events; enrolment, tokens and reports of robots."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from operator import itemgetter
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse

from engram.config import plain
from engram.errors import InputError
from engram.fleet.centre import fleet, models
from engram.fleet.centre.access import Role, disable, enrol, new_code, new_nonce, new_token
from engram.fleet.centre.database import events_after, note
from engram.fleet.centre.fleet import RobotListed, Wanted
from engram.fleet.centre.problems import ChangedError
from engram.fleet.centre.requests import Asking, CentreHere, page_of, takes
from engram.fleet.centre.service import Centre
from engram.fleet.centre.tables import MapListed, Ref
from engram.fleet.centre.tables import maps as map_table
from engram.maps.history import blame_node, map_log
from engram.maps.map import Map
from engram.weak_spots import find_weak_spots

maps_router = APIRouter(tags=["maps"])
READERS = [takes(Role.VIEWER, Role.ROBOT)]
PEOPLE = [takes(Role.VIEWER)]
Limit = Annotated[int, Query(ge=1, le=1000)]
Cursor = Annotated[int | None, Query(ge=0, le=2**62)]
Node = Annotated[str, Path(max_length=36, pattern=r"^[0-9a-fA-F-]+$")]
_EVENTS_AT_ONCE = 100


@maps_router.get("/maps", response_model=list[models.MapListed])  # type: ignore[valid-type]
def maps(centre: CentreHere, who: Asking) -> list[MapListed]:
    """The maps of the one who asks."""
    rows = centre.database.rows(MapListed, order=map_table.c.name)
    return [row for row in rows if who.role_on(row.name) is not None]


@maps_router.get("/maps/{name}", response_model=models.MapCounts, dependencies=READERS)
def one_map(name: str, centre: CentreHere) -> dict[str, Any]:
    """Counts and sizes of a map."""
    with centre.reading(name) as store:
        counts, content_hash = store.derived(Map.info), store.derived(Map.content_hash)
        return {"name": name, **plain(counts), "content_hash": content_hash}


@maps_router.get("/maps/{name}/revisions", dependencies=READERS)
def revisions(
    name: str, centre: CentreHere, cursor: Cursor = None, limit: Limit = 100
) -> models.Page:
    """The revisions, newest first."""
    log = sorted(map_log(centre.map_path(name)), key=itemgetter("number"), reverse=True)
    rest = [entry for entry in log if cursor is None or entry["number"] < cursor]
    return page_of(rest[: limit + 1], limit, "number")


@maps_router.get("/maps/{name}/diff", response_model=models.Difference, dependencies=PEOPLE)
def diff(
    name: str,
    before: Annotated[int, Query(ge=0, le=2**53)],
    after: Annotated[int, Query(ge=0, le=2**53)],
    centre: CentreHere,
) -> Any:
    """What changed between two revisions."""
    with centre.reading(name) as store:
        return store.diff(before, after).to_dict()


@maps_router.get("/maps/{name}/weak-spots", response_model=models.WeakSpots, dependencies=PEOPLE)
def weak_spots(name: str, centre: CentreHere) -> dict[str, Any]:
    """Where and at which hours the next drives will probably not be localised."""
    with centre.reading(name) as store:
        return store.derived(find_weak_spots).to_dict()


@maps_router.get("/maps/{name}/blame/{node}", response_model=models.Blame, dependencies=PEOPLE)
def blame(name: str, node: Node, centre: CentreHere) -> dict[str, Any]:
    """Where a node comes from; its UUID, or enough of its beginning."""
    return blame_node(centre.map_path(name), node)


@maps_router.get("/maps/{name}/refs", response_model=list[models.Ref], dependencies=READERS)  # type: ignore[valid-type]
def refs(name: str, centre: CentreHere) -> list[Ref]:
    """The refs; `head` is the newest revision."""
    return fleet.refs_of(centre, name)


@maps_router.get("/maps/{name}/refs/{ref}", response_model=models.Ref, dependencies=READERS)
def one_ref(name: str, ref: str, response: Response, centre: CentreHere) -> Ref:
    """One ref, with its version as ETag."""
    row = fleet.ref_of(centre, name, ref)
    response.headers["ETag"] = f'"{row.version}"'
    return row


@maps_router.put(
    "/maps/{name}/refs/{ref}", response_model=models.Ref, dependencies=[takes(Role.OPERATOR)]
)
def move_ref(
    name: str,
    ref: str,
    body: models.RefMove,
    response: Response,
    centre: CentreHere,
    who: Asking,
    if_match: Annotated[str | None, Header(examples=['"3"'])] = None,
) -> Ref:
    """Moves a ref that still has the version of `If-Match`; `"0"` makes a new one."""
    version = fleet.move_ref(centre, name, ref, body.revision, who.id, _version(if_match))
    response.headers["ETag"] = f'"{version}"'
    return fleet.ref_of(centre, name, ref)


@maps_router.delete("/maps/{name}/refs/{ref}", status_code=204, dependencies=[takes(Role.OPERATOR)])
def remove_ref(name: str, ref: str, centre: CentreHere, who: Asking) -> None:
    """Removes a ref."""
    fleet.remove_ref(centre, name, ref, who.id)


@maps_router.post("/maps/{name}/reverts", dependencies=[takes(Role.OPERATOR)])
def revert(
    name: str,
    body: models.RevertRequest,
    centre: CentreHere,
    who: Asking,
    if_match: Annotated[str | None, Header(examples=['"9"'])] = None,
) -> models.Reverted:
    """Hides what a revision added, if `head` still has the version of `If-Match`.

    Sent again after its answer was lost, it fails with 412 instead of reverting twice.
    """
    expected = _version(if_match)
    if not body.dry_run and expected is None:
        raise ChangedError("If-Match is missing: send the ETag of the ref head")
    with centre.changing(name) as store:
        if expected is not None and store.revision != expected:
            raise ChangedError(f"head is revision {store.revision}, not {expected}: read it again")
        done = store.revert(
            body.revision, author=who.name, message=body.message, dry_run=body.dry_run
        )
        number = None if done.revision is None else done.revision.number
        if number is not None:
            made = centre.prepared(name)
            with centre.database.writing() as connection:
                detail = {"reverted": body.revision, "revision": number}
                note(connection, centre.now_ns(), who.id, "revert", name, **detail)
                centre.copies.publish(connection, made)
    old, new = done.difference.old, done.difference.new
    return models.Reverted(
        revision=number,
        dry_run=body.dry_run,
        nodes={"before": old.nodes, "after": new.nodes},
        components={"before": old.components, "after": new.components},
        lost_by_others=dict(done.lost_by_others),
    )


@maps_router.get("/maps/{name}/events", dependencies=PEOPLE)
def events(
    name: str,
    request: Request,
    centre: CentreHere,
    last_event_id: Annotated[int, Header(ge=0, le=2**62)] = 0,
    follow: bool = True,
) -> StreamingResponse:
    """Changes of state as they come: server-sent events, numbered."""
    found = _events(centre, name, last_event_id, request, follow)
    return StreamingResponse(found, media_type="text/event-stream")


async def _events(
    centre: Centre, name: str, after: int, request: Request, follow: bool
) -> AsyncIterator[str]:
    def read() -> list[dict[str, Any]]:
        with centre.database.reading() as connection:
            return events_after(connection, after, name, _EVENTS_AT_ONCE)

    yield ": events\n\n"
    while True:
        batch = await run_in_threadpool(read)
        for event in batch:
            after = event["number"]
            yield f"id: {after}\nevent: {event['action']}\ndata: {json.dumps(event)}\n\n"
        if batch:
            continue
        if not follow or await request.is_disconnected():
            return
        await asyncio.sleep(centre.settings.poll_s)


@maps_router.get("/maps/{name}/audit", dependencies=[takes(Role.ADMIN)])
def audit(name: str, centre: CentreHere, cursor: Cursor = None, limit: Limit = 100) -> models.Page:
    """Every change of state, oldest first."""
    with centre.database.reading() as connection:
        rows = events_after(connection, cursor or 0, name, limit + 1)
    return page_of(rows, limit, "number")


def _version(if_match: str | None) -> int | None:
    if if_match is None:
        return None
    text = if_match.strip().strip('"')
    if not (text.isascii() and text.isdecimal()) or len(text) > 18:
        raise InputError(f"If-Match is {if_match!r:.40}; send an ETag as it was given")
    return int(text)


robots_router = APIRouter(tags=["robots"])


@robots_router.post("/robots/enrol")
def enrol_robot(body: models.Enrolment, centre: CentreHere) -> models.Enrolled:
    """Enrols a robot with a one-time code. Again with the same code and key it is the same."""
    key, signature = bytes.fromhex(body.public_key), bytes.fromhex(body.signature)
    robot = enrol(centre, body.code, body.name, key, signature)
    return models.Enrolled(robot=robot.id, maps=sorted(robot.roles))


@robots_router.post("/token/nonce")
def ask_nonce(body: models.NonceRequest, centre: CentreHere) -> models.Nonce:
    """What to sign to get a token."""
    return models.Nonce(nonce=new_nonce(centre, body.robot))


@robots_router.post("/token")
def ask_token(body: models.TokenRequest, centre: CentreHere) -> models.Token:
    """A token for a signed nonce."""
    token = new_token(centre, body.robot, body.nonce, bytes.fromhex(body.signature))
    return models.Token(token=token, expires_in_s=centre.settings.token_s)


@robots_router.get("/me")
def who_am_i(who: Asking) -> models.Me:
    """The holder of the token."""
    return models.Me(id=who.id, name=who.name, roles=dict(who.roles))


@robots_router.put(
    "/maps/{name}/robots/me/report", response_model=models.Wanted, dependencies=[takes(Role.ROBOT)]
)
def report(name: str, body: models.RobotReport, centre: CentreHere, who: Asking) -> Wanted:
    """Reports what the robot runs; answers what it is to run."""
    return fleet.note_report(centre, name, who.id, body.model_dump())


@robots_router.get(
    "/maps/{name}/robots/me", response_model=models.Wanted, dependencies=[takes(Role.ROBOT)]
)
def wanted(name: str, centre: CentreHere, who: Asking) -> Wanted:
    """What the robot is to run."""
    return fleet.wanted_by(centre, name, who.id)


@robots_router.get(
    "/maps/{name}/robots",
    response_model=list[models.RobotListed],  # type: ignore[valid-type]
    dependencies=[takes(Role.VIEWER)],
)
def robots(name: str, centre: CentreHere) -> list[RobotListed]:
    """The robots of a map and their last reports."""
    return fleet.robots_of(centre, name)


@robots_router.put(
    "/maps/{name}/robots/{robot}/follows",
    status_code=204,
    dependencies=[takes(Role.OPERATOR)],
)
def follow(name: str, robot: str, body: models.Following, centre: CentreHere, who: Asking) -> None:
    """Lets a robot follow a ref, or pins it to a revision."""
    fleet.follow(centre, name, robot, body.follows, who.id)


@robots_router.delete(
    "/maps/{name}/robots/{robot}", status_code=204, dependencies=[takes(Role.ADMIN)]
)
def take_away(name: str, robot: str, centre: CentreHere, who: Asking) -> None:
    """Revokes a robot's tokens permanently."""
    fleet.wanted_by(centre, name, robot)
    disable(centre, robot, who.id)


@robots_router.post("/maps/{name}/codes", dependencies=[takes(Role.ADMIN)])
def make_code(name: str, body: models.CodeRequest, centre: CentreHere, who: Asking) -> models.Code:
    """A code with which one robot enrols."""
    return models.Code(code=new_code(centre, name, body.follows, who.id))
