"""Routes of the pages. They take the token of ``engram centre token`` as a cookie."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime
from importlib.resources import files
from typing import Annotated, Any
from urllib.parse import parse_qs

from fastapi import APIRouter, Path, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from engram.fleet.centre import dreams, handins, jobs
from engram.fleet.centre.access import Role, Subject, names_of, subject_of
from engram.fleet.centre.database import newest_events
from engram.fleet.centre.fleet import RobotListed, refs_of, revision_of, robots_of, version_of
from engram.fleet.centre.pages.positions import (
    changes,
    drawn,
    thumbnail,
    weak_spots,
    weak_spots_of,
)
from engram.fleet.centre.problems import CentreError, UnknownError
from engram.fleet.centre.requests import COOKIE, Asking, CentreHere, takes, who_asks
from engram.fleet.centre.service import Centre
from engram.fleet.centre.tables import Artifact, HandIn
from engram.fleet.transfers import SHORT
from engram.maps.history import map_log
from engram.untrusted import printable

router = APIRouter(include_in_schema=False)
VIEWERS = [takes(Role.VIEWER)]
_SHOWN = 200
_LONGEST_LOGIN = 4096
_SCRIPTS = ("page.js", "map.js", "weak-spots.js")
_STATIC = {**dict.fromkeys(_SCRIPTS, "text/javascript"), "page.css": "text/css"}
# Nothing comes from elsewhere, and nobody frames the pages.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
)
# Names of robots and tags are anybody's: no control characters, no markup.
_templates = Environment(
    loader=PackageLoader("engram.fleet.centre.pages"),
    autoescape=True,
    finalize=lambda value: printable(value) if type(value) is str else value,
)


def _when(stamp: int | str | None) -> str:
    """A stamp, ns or ISO 8601; the page's script writes it in the reader's own time zone."""
    if not stamp:
        return "never"
    if isinstance(stamp, str):
        then = datetime.fromisoformat(stamp)
    else:
        then = datetime.fromtimestamp(stamp / 1e9, UTC)
    text = f"{then:%Y-%m-%d %H:%M} UTC"
    return Markup(f'<time datetime="{then.isoformat()}" title="{text}">{text}</time>')


_templates.filters["when"] = _when
_templates.filters["short"] = lambda one: one[:SHORT]


def _page(name: str, who: Subject | None, status: int = 200, **values: Any) -> HTMLResponse:
    body = _templates.get_template(f"{name}.html").render(page=name, who=who, **values)
    return HTMLResponse(body, status, {"Content-Security-Policy": _POLICY})


@router.get("/static/{name}")
def static(name: str) -> Response:
    """The script and the style sheet."""
    if name not in _STATIC:
        raise UnknownError(f"there is no file {name!r:.40}")
    body = (files(__package__) / "static" / name).read_bytes()
    return Response(body, media_type=_STATIC[name], headers={"Cache-Control": "max-age=3600"})


@router.get("/favicon.ico")
def no_icon() -> Response:
    """Browsers ask for it."""
    return Response(status_code=204)


@router.get("/")
def front(request: Request, centre: CentreHere) -> Response:
    """The first map of the one who asks, or the form for the token."""
    try:
        who = who_asks(request)
    except CentreError:
        return _page("login", None, map=None, wrong=False)
    names = _maps(centre, who)
    if not names:
        return _page("login", None, 403, map=None, wrong=True)
    return RedirectResponse(f"/maps/{names[0]}/map", 303)


@router.post("/login")
async def login(request: Request, centre: CentreHere) -> Response:
    """Takes a token into a cookie that scripts cannot read and other sites cannot send."""
    body = b""
    async for piece in request.stream():
        body += piece
        if len(body) > _LONGEST_LOGIN:
            return _page("login", None, 413, map=None, wrong=True)
    token = parse_qs(body.decode(errors="replace")).get("token", [""])[0].strip()
    try:
        subject_of(centre, token)
    except CentreError:
        return _page("login", None, 401, map=None, wrong=True)
    answer = RedirectResponse("/", 303)
    secure = request.url.scheme == "https"
    answer.set_cookie(COOKIE, token, httponly=True, samesite="strict", secure=secure)
    return answer


@router.post("/logout")
def logout(request: Request) -> Response:
    """Forgets the cookie. Other sites cannot log anybody out: browsers send them no cookie."""
    answer = RedirectResponse("/", 303)
    if COOKIE in request.cookies:
        answer.delete_cookie(COOKIE, httponly=True, samesite="strict")
    return answer


@router.get("/maps/{name}/map", dependencies=VIEWERS)
def map_page(name: str, centre: CentreHere, who: Asking) -> Response:
    """The map from above."""
    log = map_log(centre.map_path(name))
    return _page("map", who, map=name, maps=_maps(centre, who), head=len(log))


@router.get("/maps/{name}/nodes", dependencies=VIEWERS)
def nodes(name: str, centre: CentreHere, at: int | None = None) -> Response:
    """What the map page draws."""
    revision = revision_of(centre, name, "head" if at is None else str(max(at, 0)))
    body = drawn(centre.map_path(name), version_of(centre, name, revision), revision)
    return Response(body, media_type="application/json")


@router.get("/maps/{name}/weak-spots", dependencies=VIEWERS)
def weak(name: str, centre: CentreHere, at: int | None = None) -> Response:
    """What the map page draws of weak spots."""
    revision = revision_of(centre, name, "head" if at is None else str(max(at, 0)))
    with centre.reading(name) as store:
        if store.revision == revision:
            return Response(store.derived(weak_spots), media_type="application/json")
    body = weak_spots_of(centre.map_path(name), version_of(centre, name, revision), revision)
    return Response(body, media_type="application/json")


@router.get("/maps/{name}/nodes/{node}/picture", dependencies=VIEWERS)
def picture(
    name: str,
    node: Annotated[str, Path(pattern=r"^[0-9a-fA-F-]{4,36}$")],
    centre: CentreHere,
) -> Response:
    """The small picture of a node."""
    with centre.reading(name) as store:
        body = thumbnail(store, node)
    if body is None:
        raise UnknownError("the node has no picture")
    return Response(body, media_type="image/jpeg")


@router.get("/maps/{name}/revisions/{revision}/changes", dependencies=VIEWERS)
def changed(name: str, revision: Annotated[int, Path(ge=1)], centre: CentreHere) -> dict[str, Any]:
    """What a revision changed, in words and pictures."""
    with centre.reading(name) as store:
        return changes(store, store.resolve(revision))


@router.get("/maps/{name}/history", dependencies=VIEWERS)
def history(name: str, centre: CentreHere, who: Asking) -> Response:
    """Revisions, what merged them, refs."""
    rows = handins.listed(centre, name, limit=_SHOWN)
    names = names_of(centre)
    return _page(
        "history",
        who,
        map=name,
        maps=_maps(centre, who),
        log=map_log(centre.map_path(name))[:_SHOWN],
        refs=refs_of(centre, name),
        names=names,
        reports={row.revision: row.report for row in rows if row.report is not None},
        robots={row.revision: names.get(row.robot, row.robot) for row in rows},
        may_operate=_may_operate(who, name),
    )


@router.get("/maps/{name}/fleet", dependencies=VIEWERS)
def robots(name: str, centre: CentreHere, who: Asking) -> Response:
    """What every robot runs, and wants."""
    listed = robots_of(centre, name)
    return _page(
        "robots",
        who,
        map=name,
        maps=_maps(centre, who),
        robots=[(row, _wanted(centre, row)) for row in listed],
        named=Counter(row.name for row in listed),
        kept=handins.kept_by_robots(centre, name),
        refs=[ref.name for ref in refs_of(centre, name)],
        code_days=centre.settings.code_days,
        may_operate=_may_operate(who, name),
        may_admin=who.role_on(name) is Role.ADMIN,
    )


def _wanted(centre: Centre, row: RobotListed) -> tuple[int | None, str | None]:
    """Revision and version that a robot is to run; None where its ref is not made yet."""
    try:
        revision = revision_of(centre, row.map, row.follows)
        return revision, version_of(centre, row.map, revision)
    except UnknownError:
        return None, None


@router.get("/maps/{name}/queue", dependencies=VIEWERS)
def queue(name: str, centre: CentreHere, who: Asking) -> Response:
    """Hand-ins and downloads, with their results."""
    return _page(
        "queue",
        who,
        map=name,
        maps=_maps(centre, who),
        jobs=handins.listed(centre, name, limit=_SHOWN),
        downloads=jobs.pending(centre, Artifact, name),
        dreams=dreams.listed(centre, name),
        robots={row.robot: row.name for row in robots_of(centre, name)},
        may_operate=_may_operate(who, name),
    )


@router.get("/maps/{name}/health", dependencies=VIEWERS)
def health(name: str, centre: CentreHere, who: Asking) -> Response:
    """Whether all is well, and the last changes of state."""
    with centre.database.reading() as connection:
        broken = centre.audit.first_broken(connection, centre.now_ns())
        events = newest_events(connection, name, _SHOWN)
        path = centre.map_path(name)
    return _page(
        "health",
        who,
        map=name,
        maps=_maps(centre, who),
        broken=broken,
        whole_ns=centre.audit.whole_ns,
        events=events,
        waiting=jobs.pending(centre, HandIn, name),
        size_bytes=path.stat().st_size if path.exists() else 0,
        row=centre.map_row(name),
        silent=[row for row in robots_of(centre, name) if row.reported_ns is None],
        names=names_of(centre),
    )


def _may_operate(who: Subject, name: str) -> bool:
    return who.role_on(name) in {Role.OPERATOR, Role.ADMIN}


def _maps(centre: Centre, who: Subject) -> list[str]:
    allowed = {Role.VIEWER, Role.OPERATOR, Role.ADMIN}
    return [name for name in centre.map_names() if who.role_on(name) in allowed]
