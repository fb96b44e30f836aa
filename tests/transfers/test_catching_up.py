"""A copy of a map is brought to what a manifest lists: all of it, at the cost of what is new."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial

import pytest
from tests.builders import dies_before
from tests.maps.maps import begin, session, write_drive

from engram.errors import MapLockedError
from engram.fleet import transfers
from engram.fleet.catching_up import catch_up
from engram.fleet.transfers import MissingPartError, full_pages, split
from engram.maps.exchange import stamp_of
from engram.maps.map import Map, open_map
from engram.maps.map_files import check_file

REVISIONS = 6


def add_drive(path, number: int, nodes: int) -> None:
    with open_map(path, create=True) as store, store.writing():
        writer = begin(store, session(f"r{number}", 1_000 * (number + 1)))
        write_drive(writer, nodes)
        writer.commit()


class Growing:
    """A map as of each of its revisions, and all of its parts.

    Attributes:
        files: the map as of each revision.
        taken: the same, taken apart.
        parts: by hash.
        read: hashes that were asked for.
    """

    def __init__(self, folder) -> None:
        self.files, self.taken, self.parts = [], [], {}
        self.asked: list[bytes] = []
        path = folder / "whole.engram"
        Map.create(path).close()
        for number in range(REVISIONS + 1):
            if number == REVISIONS - 1:
                with Map.open(path, writes=True) as store:
                    store.revert(2, author="tests")
            elif number:
                add_drive(path, number, nodes=40 if number == 3 else 5)
            self.files.append(folder / f"{number}.engram")
            shutil.copyfile(path, self.files[-1])
            self.taken.append(taken := split(path))
            names = [*taken.pages, *taken.blobs]
            self.parts |= dict(zip(names, taken.parts(names), strict=True))

    def read(self, wanted):
        for part in wanted:
            self.asked.append(part)
            if part in self.parts:
                yield part, self.parts[part]


@pytest.fixture(scope="module", autouse=True)
def short_pages():
    """So that these small maps have many."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(transfers, "PAGE_BYTES", 512)
        yield


@pytest.fixture(scope="module")
def grown(short_pages, tmp_path_factory):
    return Growing(tmp_path_factory.mktemp("growing"))


@pytest.fixture
def copy(grown, tmp_path):
    def copied(number: int):
        return shutil.copyfile(grown.files[number], tmp_path / "copy.engram")

    return copied


def assert_caught_up(path, grown, to: int) -> None:
    catch_up(path, grown.taken[to].manifest, grown.read)
    assert split(path).manifest == grown.taken[to].manifest
    assert stamp_of(path) == stamp_of(grown.files[to])
    assert check_file(path).problems == ()
    with Map.open(path) as store, Map.open(grown.files[to]) as was:
        assert store.load().nodes == was.load().nodes
        assert replace(store.info(), size_bytes=0) == replace(was.info(), size_bytes=0)


@pytest.mark.parametrize("to", [0, 1, 4, REVISIONS])
@pytest.mark.parametrize("since", [0, 1, 2, 5, REVISIONS])
def test_a_copy_is_what_the_manifest_lists_from_wherever_it_was(grown, copy, since, to):
    assert_caught_up(copy(since), grown, to)


@pytest.mark.parametrize("since", [0, 2, 3])
def test_what_others_wrote_into_a_copy_goes(grown, copy, since):
    path = copy(since)
    for number in (7, 8):
        add_drive(path, number, nodes=7)
    with Map.open(path, writes=True) as store:  # and a drive that was never committed
        writer = begin(store, session("r9", 9_000))
        write_drive(writer, 3)
        writer.checkpoint()
    assert_caught_up(path, grown, 3)
    add_drive(path, 7, nodes=7)
    assert check_file(path).problems == ()


def test_the_copy_of_another_map_is_written_again(grown, tmp_path):
    path = tmp_path / "copy.engram"
    for number in (7, 8):
        add_drive(path, number, nodes=7)
    assert_caught_up(path, grown, 3)


def test_only_what_is_new_is_read(grown, copy):
    path = copy(REVISIONS - 1)
    grown.asked.clear()
    catch_up(path, grown.taken[REVISIONS].manifest, grown.read)
    pages = set(grown.taken[REVISIONS].manifest.hashes())
    assert 0 < len(set(grown.asked) - pages) <= 10  # landmarks and pictures of five nodes
    tables = grown.taken[REVISIONS].manifest.pages
    assert len(set(grown.asked) & pages) <= 2 * len(tables)
    assert len(pages) > 4 * len(tables)


@pytest.mark.parametrize("since", range(REVISIONS))
def test_a_map_is_taken_apart_from_where_an_earlier_manifest_ends(grown, since):
    before, after = grown.taken[since].manifest, grown.taken[REVISIONS]
    known = set(before.hashes())
    taken = split(grown.files[REVISIONS], None, known, full_pages(before, grown.parts.get))
    assert taken.manifest == after.manifest
    assert set(taken.pages) == set(after.pages) - known
    assert set(after.blobs) - set(grown.taken[since].blobs) <= set(taken.blobs)


def test_a_copy_without_a_part_stays_as_it_was(grown, copy):
    path = copy(2)
    lacking = dict(grown.parts)
    del lacking[next(iter(set(grown.taken[3].blobs) - set(grown.taken[2].blobs)))]

    def read(wanted):
        return ((part, lacking[part]) for part in wanted if part in lacking)

    with pytest.raises(MissingPartError):
        catch_up(path, grown.taken[3].manifest, read)
    assert split(path).manifest == grown.taken[2].manifest


def test_a_copy_that_is_written_to_is_not_caught_up(grown, copy):
    path = copy(2)
    with Map.open(path, writes=True), pytest.raises(MapLockedError):
        catch_up(path, grown.taken[3].manifest, grown.read)


def test_readers_go_on_while_a_copy_catches_up(grown, copy):
    path = copy(2)
    with Map.open(path, at=2) as store:
        catch_up(path, grown.taken[REVISIONS].manifest, grown.read)
        assert len(store.load().nodes) == 10


def test_a_kill_leaves_a_copy_as_it_was_or_caught_up(grown, copy):
    states = {grown.taken[at].manifest.id for at in (2, 4)}
    for statement in range(0, 60, 6):
        path = copy(2)
        dies_before(statement, partial(catch_up, path, grown.taken[4].manifest, grown.read))
        assert split(path).manifest.id in states
        assert_caught_up(path, grown, 4)
        path.unlink()
