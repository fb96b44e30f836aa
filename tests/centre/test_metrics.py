"""What the service counts of its answers."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

from engram.fleet.centre import application
from engram.fleet.centre.application import create_app


@pytest.mark.parametrize(("link_s", "own_s", "within"), [(100.0, 0.02, 0.05), (0.0, 3.0, 5.0)])
def test_a_slow_link_is_no_slow_answer(site, monkeypatch, link_s, own_s, within):
    now = 0.0
    monkeypatch.setattr(application, "time", SimpleNamespace(perf_counter=lambda: now))

    async def receive():
        nonlocal now
        now += link_s
        return {"type": "http.request", "body": b"", "more_body": False}

    async def answer(scope, receive, send):
        nonlocal now
        await receive()
        now += own_s
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def send(message):
        pass

    app = create_app(site.centre)
    counting = application._Counting(answer)
    asyncio.run(counting({"type": "http", "app": app}, receive, send))
    assert app.state.answers == {200: 1}
    assert app.state.seconds == pytest.approx(own_s)
    assert min(limit for limit, count in app.state.within.items() if count) == within
