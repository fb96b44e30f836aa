"""Objects in a folder and in a bucket answer alike."""

from __future__ import annotations

import pytest

from engram.errors import MapError
from engram.fleet.centre.objects import BucketObjects, FolderObjects
from engram.fleet.centre.problems import StoreError


@pytest.fixture(params=["folder", "bucket", "s3"])
def objects(request, tmp_path):
    if request.param == "folder":
        return FolderObjects(tmp_path / "objects")
    if request.param == "s3":
        return BucketObjects(f"{request.getfixturevalue('s3')}/{tmp_path.name}")
    (tmp_path / "bucket").mkdir()
    return BucketObjects((tmp_path / "bucket").as_uri())


def test_what_is_put_is_got_whole_and_in_ranges(objects, tmp_path):
    body = bytes(range(256)) * 40
    objects.put("packs/fleet/a", body)
    assert objects.get("packs/fleet/a") == body
    assert objects.get("packs/fleet/a", 100, 7) == body[100:107]
    assert objects.size("packs/fleet/a") == len(body)
    objects.put("packs/fleet/a", body)
    (tmp_path / "file").write_bytes(body[::-1])
    objects.put_file("packs/town/b", tmp_path / "file")
    assert objects.get("packs/town/b") == body[::-1]
    assert list(objects.keys("packs/fleet")) == ["packs/fleet/a"]
    assert sorted(objects.keys("packs")) == ["packs/fleet/a", "packs/town/b"]


def test_what_is_missing_is_named(objects):
    for ask in (objects.get, objects.size):
        with pytest.raises(MapError, match="packs/x is missing"):
            ask("packs/x")


def test_what_is_deleted_is_gone(objects):
    objects.put("a/b", b"x")
    objects.delete("a/b")
    assert list(objects.keys("a")) == []


def test_what_cannot_be_kept_now_is_told_apart_from_what_is_missing(objects, tmp_path, request):
    if "s3" in request.node.callspec.id:
        pytest.skip("only a bucket in a folder can be made to fail")
    for folder in (tmp_path / "objects", tmp_path / "bucket"):
        if folder.exists():
            folder.rmdir()
        folder.write_bytes(b"in its way")
    with pytest.raises(StoreError, match="packs/a"):
        objects.put("packs/a", b"x")
