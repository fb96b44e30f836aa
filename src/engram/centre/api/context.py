"""What every route works with: the centre, the caller, and the roles that a route accepts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import Depends, Request

from engram.centre.access.enrolment import subject_of
from engram.centre.access.roles import Role, Subject
from engram.centre.errors import NotKnownError
from engram.centre.service import Centre

COOKIE = "engram_token"


async def centre_of(request: Request) -> Centre:
    """The centre of the application."""
    return _centre(request)


def _centre(request: Request) -> Centre:
    found: Centre = request.app.state.centre
    return found


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
    return subject_of(_centre(request), token)


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


def page_of(
    items: list[dict[str, Any]], limit: int, cursor: Callable[[dict[str, Any]], object]
) -> dict[str, Any]:
    """A page of a list that was read with one item more than its limit."""
    more = len(items) > limit
    shown = items[:limit]
    return {"items": shown, "next": str(cursor(shown[-1])) if more and shown else None}
