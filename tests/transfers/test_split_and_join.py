"""A map taken apart and put together again is the same map."""

from __future__ import annotations

import numpy as np
import pytest
from tests.fleet.robots import robot_map
from tests.maps.test_forgetting import write_town

from engram.errors import InputError, MapCorruptError
from engram.fleet.transfers import (
    MissingPartError,
    Unbundler,
    bundle,
    decode_manifest,
    encode_manifest,
    join,
    split,
)
from engram.maps.forgetting import Chosen, erase_map
from engram.maps.map import Map
from engram.maps.map_files import check_file


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """A robot's map after its first and after its second drive."""
    path = tmp_path_factory.mktemp("parts") / "r1.engram"
    robot_map(path, np.arange(0, 16, 0.8), day=1)
    first = split(path)
    first = split(path), everything(first)
    robot_map(path, np.arange(0, 24, 0.8), 1, day=2)
    return path, first[0], first[1], split(path)


def everything(taken):
    names = [*taken.pages, *taken.blobs]
    return dict(zip(names, taken.parts(names), strict=True))


def test_the_same_map_comes_out(tmp_path, drives):
    path, *_, taken = drives
    parts = everything(taken)
    join(taken.manifest, parts.get, tmp_path / "again.engram")
    assert check_file(tmp_path / "again.engram").problems == ()
    with Map.open(path) as was, Map.open(tmp_path / "again.engram") as now:
        assert now.content_hash() == was.content_hash()
        assert now.load().nodes == was.load().nodes
    assert split(tmp_path / "again.engram").manifest.id == taken.manifest.id


def test_erased_rows_travel_as_receipts(tmp_path):
    town, path = write_town(tmp_path / "town.engram"), tmp_path / "town.engram"
    with Map.open(path) as store:
        chosen = Chosen(sessions=frozenset([town[-1].session.id]))
        store.forget_nodes(chosen, author="tests", message="", configuration={})
    erase_map(path)
    for at in (3, 4):  # before it was forgotten, and after
        taken = split(path, at)
        again = tmp_path / f"again{at}.engram"
        join(taken.manifest, everything(taken).get, again)
        assert check_file(again).problems == ()
        with Map.open(again) as store, Map.open(path, at=at) as was:
            assert store.content_hash() == was.content_hash()
            assert len(store.load().nodes) == len(store.read_graph()) == 6
            pages = store.pages
            assert sorted(pages.unused(pages.end)) == []
            pages.experiences(pages.part(0, pages.end).nodes)


def test_a_later_map_repeats_little_of_an_earlier_one(drives):
    _, before, parts, after = drives
    again = after.manifest.on_wire(before.manifest)
    assert again.full(before.manifest) == after.manifest
    new_pages = set(after.pages) - set(parts)
    # At most the last page of each table is sent again, beside those of the new rows.
    repeated = len(before.pages) - len(set(before.pages) & set(after.pages))
    assert repeated <= len(after.manifest.pages)
    assert new_pages
    assert set(before.blobs) <= set(after.blobs)


def test_a_missing_part_is_named_and_leaves_no_file(tmp_path, drives):
    *_, taken = drives
    parts = everything(taken)
    gone = next(iter(taken.blobs))
    with pytest.raises(MissingPartError) as raised:
        join(taken.manifest, lambda one: None if one == gone else parts.get(one), tmp_path / "x")
    assert raised.value.part == gone
    assert list(tmp_path.iterdir()) == []


def test_a_thin_map_lacks_frames_and_nothing_else(tmp_path, drives):
    path, *_, taken = drives
    thin = tmp_path / "thin.engram"
    join(taken.manifest, taken.pages.get, thin, thin=True) if not taken.blobs else None
    vocabularies = {one for one, (table, *_) in taken.blobs.items() if table.name != "frames"}
    parts = everything(taken)
    kept = {one: parts[one] for one in [*taken.pages, *vocabularies]}
    thin.unlink(missing_ok=True)
    join(taken.manifest, kept.get, thin, thin=True)
    assert check_file(thin, thin=True).problems == ()
    assert check_file(thin).problems
    with Map.open(path) as was, Map.open(thin) as now:
        assert now.content_hash() == was.content_hash()


def test_another_map_than_the_manifest_says_is_refused(tmp_path, drives):
    _, before, _, taken = drives
    wrong = before.manifest.__class__(before.manifest.content_hash, 2, taken.manifest.pages)
    with pytest.raises(MapCorruptError, match="make a map of content"):
        join(wrong, everything(taken).get, tmp_path / "x.engram")
    assert list(tmp_path.glob("*.engram")) == []


def test_bundles_come_apart_in_any_pieces(drives):
    *_, taken = drives
    parts = everything(taken)
    body = b"".join(bundle(parts.values()))
    for step in (1009, 65536, len(body)):
        opened = Unbundler()
        found = [
            one for at in range(0, len(body), step) for one in opened.feed(body[at : at + step])
        ]
        assert dict(found) == parts
    cut = list(Unbundler().feed(body[: len(body) // 2]))
    assert 0 < len(cut) < len(parts)


def test_a_changed_byte_and_a_bomb_are_refused(drives):
    body = bytearray(b"".join(bundle([b"x" * 5000])))
    body[-1] ^= 1
    with pytest.raises(InputError):
        list(Unbundler().feed(bytes(body)))
    body = b"".join(bundle([bytes(5000)]))
    small = body[:32] + (4999).to_bytes(4, "big") + body[36:]
    with pytest.raises(InputError, match="it announces"):
        list(Unbundler().feed(small))
    with pytest.raises(InputError, match="at most"):
        list(Unbundler().feed(body[:32] + (2**31).to_bytes(4, "big") + body[36:]))


def test_a_manifest_survives_its_encoding(drives):
    *_, taken = drives
    assert decode_manifest(encode_manifest(taken.manifest)) == taken.manifest
