"""What every route works with: the centre, the caller, roles; and errors as problem details."""

from __future__ import annotations

import logging
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, RedirectResponse, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from engram.errors import (
    EngramError,
    IncompatibleError,
    InputError,
    MapLockedError,
    RevisionError,
    StorageFullError,
)
from engram.fleet.centre.access import Role, Subject, subject_of
from engram.fleet.centre.models import Page, Problem
from engram.fleet.centre.problems import CentreError, NotKnownError, StoreError
from engram.fleet.centre.service import Centre

COOKIE = "engram_token"


async def centre_of(request: Request) -> Any:
    """The centre of the application."""
    return request.app.state.centre


def who_asks(request: Request) -> Subject:
    """The caller of a request, by its token.

    Raises:
        NotKnownError: the request is not authenticated.
    """
    kind, _, token = request.headers.get("authorization", "").partition(" ")
    if kind.lower() != "bearer":
        token = request.cookies.get(COOKIE, "") if _reads_only(request) else ""
    if not token:
        raise NotKnownError("send Authorization: Bearer TOKEN")
    return subject_of(request.app.state.centre, token)


def _reads_only(request: Request) -> bool:
    """A cookie alone changes nothing: other sites could make a browser send it."""
    return request.method in {"GET", "HEAD"} or request.headers.get("x-engram") == "page"


CentreHere = Annotated[Centre, Depends(centre_of)]
Asking = Annotated[Subject, Depends(who_asks)]


def takes(*roles: Role) -> Any:
    """Refuses who has none of these roles on the map of the path."""

    async def check(name: str, who: Asking) -> None:  # a thread for it would take longer
        who.check(name, *roles)

    check.roles = roles  # type: ignore[attr-defined]
    return Depends(check)


def page_of(items: list[dict[str, Any]], limit: int, cursor: str) -> Page:
    """A page of a list that was read with one item more than its limit."""
    shown = items[:limit]
    return Page(items=shown, next=str(shown[-1][cursor]) if len(items) > limit else None)


MEDIA = "application/problem+json"
_log = logging.getLogger(__name__)
# For the description of the API: any request can fail in this way.
DESCRIBED: dict[int | str, dict[str, Any]] = {
    "4XX": {
        "description": "The request failed.",
        "content": {MEDIA: {"schema": Problem.model_json_schema()}},
    }
}

_STATUS: tuple[tuple[type[EngramError], int], ...] = (
    (MapLockedError, 409),
    (RevisionError, 404),
    (IncompatibleError, 409),
    (StorageFullError, 507),
    (StoreError, 503),
    (InputError, 422),
)


def problem(status: int, title: str, detail: str, **more: Any) -> JSONResponse:
    """The answer to a request that failed."""
    body = {"type": "about:blank", "title": title, "status": status, "detail": detail, **more}
    headers = {"WWW-Authenticate": "Bearer"} if status == HTTPStatus.UNAUTHORIZED else None
    return JSONResponse(body, status, headers, media_type=MEDIA)


def add_problems(app: FastAPI) -> None:
    """Lets an application answer errors with problem details."""

    @app.exception_handler(EngramError)
    def foreseen(request: Request, error: EngramError) -> Response:
        words = request.app.state.centre.words_of(error)
        if isinstance(error, CentreError):
            status, title = error.status, error.title
        else:
            status = next((code for kind, code in _STATUS if isinstance(error, kind)), 500)
            title = HTTPStatus(status).phrase
        if status == HTTPStatus.UNAUTHORIZED:  # a token that has ended is nobody's fault
            if request.headers.get("accept", "").startswith("text/html"):  # somebody at a browser
                return RedirectResponse("/", 303)
        else:
            _log.info("%s %s: %d %s", request.method, request.url.path, status, words)
        return problem(status, title, words)

    @app.exception_handler(HTTPException)
    def refused(_: Request, error: HTTPException) -> JSONResponse:
        return problem(error.status_code, HTTPStatus(error.status_code).phrase, str(error.detail))

    @app.exception_handler(ClientDisconnect)
    def gone(_: Request, __: ClientDisconnect) -> JSONResponse:  # nobody reads it
        return problem(400, "The link broke", "what had arrived whole is kept")

    @app.exception_handler(RequestValidationError)
    def malformed(_: Request, error: RequestValidationError) -> JSONResponse:
        faults = [
            {"where": ".".join(map(str, fault["loc"])), "what": str(fault["msg"])}
            for fault in error.errors()
        ]
        detail = "; ".join(f"{fault['where']}: {fault['what']}" for fault in faults)
        return problem(422, "The request is malformed", detail, faults=faults)
