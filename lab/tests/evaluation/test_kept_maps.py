"""Maps that stay open for the next drive."""

import shutil
from pathlib import Path

import pytest
from tests.maps import maps

from engram.errors import MapError
from engram.maps.map import open_map
from engram_lab.studies.drives import KeptMaps


@pytest.fixture
def town(tmp_path: Path) -> Path:
    """A map of two drives of five nodes."""
    path = tmp_path / "town.engram"
    with open_map(path, create=True) as store, store.writing():
        for number in range(2):
            drive = maps.session(start_ns=1_000 + number * 10**12)
            writer = maps.begin(store, drive)
            maps.write_drive(writer)
            writer.commit()
    return path


def test_a_map_that_was_asked_for_before_is_the_same_one(town: Path) -> None:
    kept = KeptMaps(files=1)
    newest, first = kept.open(town), kept.open(town, at=1)
    assert (len(newest.graph), len(first.graph)) == (10, 5)
    assert kept.open(town) is newest
    assert kept.open(town, at=1) is first
    kept.close()
    assert kept.open(town) is not newest
    kept.close()


def test_the_file_that_was_asked_for_longest_ago_is_closed(town: Path) -> None:
    others = [town.with_name(f"other-{number}.engram") for number in range(2)]
    for other in others:
        shutil.copyfile(town, other)
    kept = KeptMaps(files=2)
    opened = kept.open(town)
    between = kept.open(others[0])
    assert kept.open(town) is opened
    kept.open(others[1])
    assert kept.open(town) is opened
    assert kept.open(others[0]) is not between
    kept.close()


def test_a_map_that_was_made_anew_is_opened_anew(town: Path) -> None:
    kept = KeptMaps(files=2)
    opened = kept.open(town)
    draft = town.with_name("draft.engram")
    shutil.copyfile(town, draft)
    draft.replace(town)
    assert kept.open(town) is not opened
    kept.close()


def test_what_is_no_map_is_refused_again_and_again(tmp_path: Path) -> None:
    path = tmp_path / "town.engram"
    path.write_bytes(b"no map")
    kept = KeptMaps(files=1)
    for _ in range(2):
        with pytest.raises(MapError):
            kept.open(path)
    kept.close()
