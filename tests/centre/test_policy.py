"""How a map takes hand-ins, as its row keeps it."""

from __future__ import annotations

import json
from dataclasses import fields

import pytest
from sqlalchemy import update

from engram.cli.settings import AllSettings
from engram.fleet.centre.database import maps
from engram.fleet.centre.service import Centre, MapPolicy
from engram.fleet.merge.settings import MergeOptions

# The ranking stood under `policy`, and none was null.
_OLD = {
    "merge": {"policy": "path", "lanes": 1, "rounds": 8, "relocaliser": None, "author": "me"},
    "gate": ["held-out.framelog"],
    "moves": "stable",
    "quiet": None,
}


@pytest.mark.parametrize("relocaliser", [None, "exhaustive"])
def test_a_policy_of_an_older_version_is_read(tmp_path, relocaliser):
    options = {**_OLD, "merge": {**_OLD["merge"], "relocaliser": relocaliser}}
    merge = MergeOptions("path", 1, 8, relocaliser or "none", author="me")
    with Centre(tmp_path) as centre:
        centre.add_map("fleet", "tests")
        with centre.database.writing() as connection:
            connection.execute(update(maps).values(options=json.dumps(options)))
        read = centre.policy("fleet")
        assert read == MapPolicy(merge, ("held-out.framelog",), "stable")
        centre.set_policy("fleet", read, "tests")
        assert centre.policy("fleet") == read


def test_a_merge_goes_by_the_settings_of_the_table():
    settings, options = AllSettings().merge, MergeOptions.of(AllSettings().merge, "me")
    assert {one.name for one in fields(options)} - {one.name for one in fields(settings)} == {
        "author"
    }
    assert options == MergeOptions(author="me")
