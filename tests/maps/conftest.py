"""Where maps lie in tests: files always, PostgreSQL when ENGRAM_TEST_POSTGRES names one."""

from __future__ import annotations

import os
import uuid

import pytest
from sqlalchemy import create_engine, make_url, text

from engram.centre.postgresql import PostgresMap


def new_postgres_map() -> tuple[str, PostgresMap]:
    """Address of a map that does not exist yet, and what opens it."""
    url = make_url(os.environ["ENGRAM_TEST_POSTGRES"]).update_query_dict(
        {"map": f"test_{uuid.uuid4().hex}"}
    )
    address = url.render_as_string(hide_password=False)
    return address, PostgresMap(address)


def drop_postgres_map(address: str) -> None:
    url = make_url(address)
    engine = create_engine(url.difference_update_query(["map"]))
    with engine.begin() as connection:
        connection.execute(text(f'DROP SCHEMA IF EXISTS "{url.query["map"]}" CASCADE'))
    engine.dispose()


KINDS = ["sqlite", *(["postgresql"] if os.environ.get("ENGRAM_TEST_POSTGRES") else [])]


@pytest.fixture(params=KINDS)
def location(request, tmp_path):
    """A place for a map, in every kind of database."""
    if request.param == "sqlite":
        yield tmp_path / "town.engram"
        return
    address, place = new_postgres_map()
    yield place
    drop_postgres_map(address)
