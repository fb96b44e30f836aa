"""How a map takes hand-ins, as its row keeps it."""

from __future__ import annotations

from dataclasses import fields

import pytest
from sqlalchemy import update

from engram.cli.settings import AllSettings
from engram.errors import FormatVersionError
from engram.fleet.centre.service import Centre, MapPolicy
from engram.fleet.centre.tables import Published, centre, published
from engram.fleet.merge.merge_settings import MergeOptions

from .conftest import drive


def test_a_policy_is_read_as_it_was_set(tmp_path):
    merge = MergeOptions("path", 1, 8, "none", author="me")
    policy = MapPolicy(merge, ("held-out.framelog",), "stable", (22.0, 5.0), cap_bytes=10**9)
    with Centre(tmp_path) as centre:
        centre.add_map("fleet", "tests", policy)
    with Centre(tmp_path) as centre:
        assert centre.policy("fleet") == policy


@pytest.mark.parametrize("version", [1, 2, 5])
def test_tables_of_another_version_are_refused_with_what_to_do(tmp_path, version):
    with Centre(tmp_path) as opened, opened.database.writing() as connection:
        connection.execute(update(centre).values(version=version))
    with pytest.raises(FormatVersionError, match=rf"of version {version}, .* enrol the robots"):
        Centre(tmp_path)


def test_tables_from_before_copies_get_the_table_that_they_lack(tmp_path):
    with Centre(tmp_path) as opened, opened.database.writing() as connection:
        published.drop(connection)
        connection.execute(update(centre).values(version=3))
    with Centre(tmp_path) as opened:
        assert opened.database.rows(Published) == []
        opened.add_map("fleet", "tests")
    Centre(tmp_path).close()


def test_maps_that_were_copied_into_a_new_centre_are_served_there(tmp_path):
    (tmp_path / "maps").mkdir()
    drive(tmp_path / "maps" / "fleet.engram", "r1", 1_000)
    with Centre(tmp_path) as opened:
        opened.add_map("fleet", "tests")
        with opened.reading("fleet") as store:
            assert store.revision == 1


def test_a_merge_goes_by_the_settings_of_the_table():
    settings, options = AllSettings().merge, MergeOptions.of(AllSettings().merge, "me")
    assert {one.name for one in fields(options)} - {one.name for one in fields(settings)} == {
        "author"
    }
    assert options == MergeOptions(author="me")
