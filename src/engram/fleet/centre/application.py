"""The application: routes, problems, health."""

from __future__ import annotations

import time
from collections import Counter

from fastapi import FastAPI, Request
from fastapi.responses import PlainTextResponse
from sqlalchemy import func, select
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from engram import __version__
from engram.fleet.centre import transfer_routes
from engram.fleet.centre.models import Health
from engram.fleet.centre.pages import page_routes as pages
from engram.fleet.centre.requests import DESCRIBED, CentreHere, add_problems
from engram.fleet.centre.routes import maps_router, robots_router
from engram.fleet.centre.service import Centre
from engram.fleet.centre.tables import artifacts, dreams, handins

_ABOUT = """The fleet's shared map as a service: robots hand in what they saw, and download what the
next mission needs. Errors are problem details (RFC 9457). Whatever is sent twice is done once."""

# Limits of the histogram of answers' times, s.
_WITHIN_S = (0.01, 0.05, 0.1, 0.2, 0.5, 1.0, 5.0)


def create_app(centre: Centre) -> FastAPI:
    """The HTTP interface of a centre."""
    app = FastAPI(
        title="Engram centre",
        version=__version__,
        description=_ABOUT,
        docs_url=None,
        redoc_url=None,
        responses=DESCRIBED,
    )
    app.state.centre = centre
    app.state.answers = Counter[int]()
    app.state.seconds, app.state.within = 0.0, Counter[float]()
    add_problems(app)
    for router in (maps_router, robots_router, transfer_routes.router):
        app.include_router(router, prefix="/v1")
    app.include_router(pages.router)
    app.add_api_route("/v1/health", _health, tags=["service"])
    app.add_api_route("/v1/metrics", _metrics, tags=["service"], response_class=PlainTextResponse)
    app.add_middleware(_Counting)
    return app


class _Counting:
    """Counts answers and their time, and adds headers that every answer has.

    The time is the centre's own: that in which a slow link brings the request is not counted.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started, waited_s = time.perf_counter(), 0.0

        async def request() -> Message:
            nonlocal waited_s
            began = time.perf_counter()
            message = await receive()
            waited_s += time.perf_counter() - began
            return message

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                state = scope["app"].state
                state.answers[message["status"]] += 1
                took_s = time.perf_counter() - started - waited_s
                state.seconds += took_s
                state.within.update(limit_s for limit_s in _WITHIN_S if took_s <= limit_s)
                headers = MutableHeaders(scope=message)
                headers["X-Content-Type-Options"] = "nosniff"
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        await self._app(scope, request, answer)


def _health(centre: CentreHere) -> Health:
    """Whether the service answers and reaches its database; nothing about maps."""
    with centre.database.reading() as connection:
        connection.execute(select(1))
    return Health(status="ok", version=__version__)


def _metrics(request: Request, centre: CentreHere) -> str:
    """Counters for Prometheus; no names of maps or robots."""
    state = request.app.state
    lines = ["# TYPE engram_answers_total counter"]
    lines += [
        f'engram_answers_total{{status="{code}"}} {count}'
        for code, count in sorted(state.answers.items())
    ]
    count = sum(state.answers.values())
    lines += ["# TYPE engram_answer_seconds histogram"]
    lines += [
        f'engram_answer_seconds_bucket{{le="{limit_s}"}} {state.within[limit_s]}'
        for limit_s in _WITHIN_S
    ]
    lines += [f'engram_answer_seconds_bucket{{le="+Inf"}} {count}']
    lines += [f"engram_answer_seconds_sum {state.seconds:.6f}"]
    lines += [f"engram_answer_seconds_count {count}"]
    with centre.database.reading() as connection:
        for table in (handins, artifacts, dreams):
            query = select(table.c.state, func.count()).group_by(table.c.state)
            lines += [f"# TYPE engram_{table.name} gauge"]
            lines += [
                f'engram_{table.name}{{state="{named}"}} {count}'
                for named, count in connection.execute(query)
            ]
    return "\n".join(lines) + "\n"
