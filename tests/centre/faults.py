"""Kills and broken links, injected."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import httpx
from sqlalchemy import Engine, event

from engram.fleet.agent.agent_state import AgentState

_CALLS = ("fsync", "replace", "rename", "link", "unlink")


class Killed(BaseException):
    """The process ended here."""


class Death:
    """Kills before the n-th fsync, rename, unlink or commit; nothing is written from then on.

    Attributes:
        count: how many of them were reached.
        came: whether it killed.
    """

    def __init__(self, at: int | None = None) -> None:
        self.at = at
        self.count = 0
        self.came = False

    def pass_by(self) -> None:
        self.count += 1
        if self.at is not None and self.count >= self.at:
            self.came = True
            raise Killed


@contextmanager
def dying(at: int | None) -> Iterator[Death]:
    """Within the block the process may die; the exception comes out of it."""
    death = Death(at)
    real = {name: getattr(os, name) for name in _CALLS}

    def guarded(call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any, **options: Any) -> Any:
            death.pass_by()
            return call(*arguments, **options)

        return run

    def commit(_: Any) -> None:
        death.pass_by()

    commit_of_agent = AgentState._commit

    def commit_agent(state: AgentState) -> None:
        death.pass_by()
        commit_of_agent(state)

    for name, call in real.items():
        setattr(os, name, guarded(call))
    AgentState._commit = commit_agent
    event.listen(Engine, "commit", commit)
    try:
        yield death
    finally:
        for name, call in real.items():
            setattr(os, name, call)
        AgentState._commit = commit_of_agent
        event.remove(Engine, "commit", commit)


class FlakyClient:
    """A client whose next requests meet the given fates.

    ``lost``: the request does not arrive. ``unanswered``: it does, the answer does not. ``twice``:
    it arrives twice. A share: so much of its body, or of its answer's, arrives, then nothing.
    """

    def __init__(self, client: httpx.Client) -> None:
        self._client = client
        self.fates: list[str | float] = []

    def _fate(self) -> str | float:
        return self.fates.pop(0) if self.fates else "well"

    def post(self, path: str, **options: Any) -> httpx.Response:
        return self.request("POST", path, **options)

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        fate = self._fate()
        if "content" in options:
            options["content"] = b"".join(options["content"])
        if fate == "lost":
            raise httpx.ConnectError("lost")
        if isinstance(fate, float) and "content" in options:
            options["content"] = options["content"][: int(fate * len(options["content"]))]
        answer = self._client.request(method, path, **options)
        if fate == "twice":
            answer = self._client.request(method, path, **options)
        if fate == "unanswered" or isinstance(fate, float):
            raise httpx.ReadError("unanswered")
        return answer

    @contextmanager
    def stream(self, method: str, path: str, **options: Any) -> Iterator[Any]:
        fate = self._fate()
        if fate in {"lost", "unanswered"}:
            raise httpx.ConnectError("lost")
        answer = self._client.request(method, path, **options)
        yield _Streamed(answer, fate if isinstance(fate, float) else None)


class _Streamed:
    def __init__(self, answer: httpx.Response, share: float | None) -> None:
        self.status_code = answer.status_code
        self._answer = answer
        self._share = share

    def read(self) -> bytes:
        return self._answer.content

    def json(self) -> Any:
        return self._answer.json()

    def iter_bytes(self, size: int = 4_096) -> Iterator[bytes]:
        body = self._answer.content
        if self._share is not None:
            body = body[: int(self._share * len(body))]
        for at in range(0, len(body), size):
            yield body[at : at + size]
        if self._share is not None:
            raise httpx.ReadError("cut")
