"""Wakes workers by NOTIFY on PostgreSQL. The poll stays, for whatever is missed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sqlalchemy import Connection, make_url, text

_CHANNEL = "engram_work"


def ring(connection: Connection) -> None:
    """Announces work, once the transaction that is open commits."""
    if connection.dialect.name == "postgresql":
        connection.execute(text(f"NOTIFY {_CHANNEL}"))


class Waker:
    """Waits for work. A context manager.

    Args:
        database: address of the service's database; None for SQLite.
        sleep: waits some seconds, or until the worker is stopped.
    """

    def __init__(self, database: str | None, sleep: Callable[[float], object]) -> None:
        url = None if database is None else make_url(database)
        self._url = url if url is not None and url.get_backend_name() == "postgresql" else None
        self._sleep = sleep
        self._line: Any = None  # psycopg's connection

    def __enter__(self) -> Waker:
        return self

    def __exit__(self, *_: object) -> None:
        self._hang_up()

    def wait(self, seconds: float) -> None:
        """Returns after some seconds, or as soon as there is work; a broken line is a sleep."""
        if self._url is None:
            self._sleep(seconds)
            return
        import psycopg

        try:
            self._listen(seconds)
        except psycopg.Error:  # the database is away: the poll finds out, and tells
            self._hang_up()
            self._sleep(seconds)

    def _listen(self, seconds: float) -> None:
        import psycopg

        if self._line is None:
            assert self._url is not None
            address = self._url.set(drivername="postgresql")
            self._line = psycopg.connect(
                address.render_as_string(hide_password=False), autocommit=True
            )
            self._line.execute(f"LISTEN {_CHANNEL}")
            return  # what was announced before is found by looking
        for _ in self._line.notifies(timeout=seconds, stop_after=1):
            pass

    def _hang_up(self) -> None:
        line, self._line = self._line, None
        if line is not None:
            line.close()
