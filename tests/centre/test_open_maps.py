"""Maps that stay open: as they are now for who asks, as they were for who still reads."""

from __future__ import annotations

import pytest

from engram.errors import EngramError
from engram.fleet.centre.problems import UnknownError
from engram.fleet.centre.service import log_of

from .conftest import NAME, drive


def test_a_map_stays_open_until_it_has_a_new_revision(site):
    path = site.centre.map_path(NAME)
    with site.centre.reading(NAME) as first:
        assert (first.revision, log_of(first)) == (0, ())
    with site.centre.reading(NAME) as again:
        assert again is first
        drive(path, "r1", 1_000)
        with site.centre.reading(NAME) as second:
            assert second is not first
            assert (second.revision, len(log_of(second))) == (1, 1)
        assert again.node_count() == 0  # as it was when its reader began


def test_a_map_that_nobody_reads_any_more_is_closed(site, monkeypatch):
    closed = []
    with site.centre.reading(NAME) as store:
        monkeypatch.setattr(store, "close", lambda: closed.append(store))
        drive(site.centre.map_path(NAME), "r1", 1_000)
        with site.centre.reading(NAME):
            assert closed == []
    assert closed == [store]


def test_a_map_that_was_put_in_place_of_another_is_the_one_that_is_read(site, tmp_path):
    path = site.centre.map_path(NAME)
    with site.centre.reading(NAME) as store:
        assert store.revision == 0
    restored = tmp_path / "restored.engram"
    drive(restored, "r1", 1_000)
    restored.replace(path)
    with site.centre.reading(NAME) as store:
        assert store.revision == 1
    path.unlink()
    for _ in range(2):
        with pytest.raises(EngramError), site.centre.reading(NAME):
            pass


def test_a_map_that_is_not_there_is_not_known(site):
    with pytest.raises(UnknownError), site.centre.reading("nowhere"):
        pass
