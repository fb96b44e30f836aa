"""Errors as problem details (RFC 9457)."""

from __future__ import annotations

import logging
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, RedirectResponse, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from engram.centre.api.models import Problem
from engram.centre.errors import CentreError, StoreError
from engram.errors import (
    EngramError,
    IncompatibleError,
    InputError,
    MapLockedError,
    RevisionError,
    StorageFullError,
)

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
        told = request.app.state.centre.words_of(error)
        if isinstance(error, CentreError):
            status, title = error.status, error.title
        else:
            status = next((code for kind, code in _STATUS if isinstance(error, kind)), 500)
            title = HTTPStatus(status).phrase
        if status == HTTPStatus.UNAUTHORIZED:  # a token that has ended is nobody's fault
            if request.headers.get("accept", "").startswith("text/html"):  # somebody at a browser
                return RedirectResponse("/", 303)
        else:
            _log.info("%s %s: %d %s", request.method, request.url.path, status, told)
        return problem(status, title, told)

    @app.exception_handler(HTTPException)
    def refused(_: Request, error: HTTPException) -> JSONResponse:
        return problem(error.status_code, HTTPStatus(error.status_code).phrase, str(error.detail))

    @app.exception_handler(ClientDisconnect)
    def gone(_: Request, __: ClientDisconnect) -> JSONResponse:  # nobody reads it
        return problem(400, "The link broke", "what had arrived whole is kept")

    @app.exception_handler(RequestValidationError)
    def malformed(_: Request, error: RequestValidationError) -> JSONResponse:
        faults = [
            {"where": ".".join(map(str, one["loc"])), "what": str(one["msg"])}
            for one in error.errors()
        ]
        detail = "; ".join(f"{one['where']}: {one['what']}" for one in faults)
        return problem(422, "The request is malformed", detail, faults=faults)
