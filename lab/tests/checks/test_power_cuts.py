"""A disk that keeps only what was synced, and maps on it."""

from __future__ import annotations

import random
import shutil
import sys

import pytest

from engram_lab.checks.power_cuts import Cuts, Deed, Disk, Done


def done(deed: Deed, file: int = 0, path: str = "", data: bytes = b"", offset: int = 0) -> Done:
    return Done(deed, file, offset, len(data), path, data)


def left(deeds: list[Done], seed: int) -> dict[str, bytes]:
    """Files after a cut."""
    disk = Disk()
    for one in deeds:
        disk.take(one)
    disk.settle(random.Random(seed))
    return {name: bytes(disk.contents.get(number, b"")) for name, number in disk.names.items()}


NAMED = [done(Deed.CREATE, 1, "/maps/a"), done(Deed.SYNC_FOLDER, path="/maps")]


def test_what_is_synced_stays():
    deeds = [*NAMED, done(Deed.WRITE, 1, data=b"kept"), done(Deed.SYNC, 1)]
    assert all(left(deeds, seed) == {"/maps/a": b"kept"} for seed in range(50))


def test_what_is_not_synced_is_there_missing_or_torn():
    deeds = [*NAMED, done(Deed.WRITE, 1, data=b"x" * 1024)]
    found = {left(deeds, seed)["/maps/a"] for seed in range(100)}
    assert found == {b"", b"x" * 512, b"x" * 1024, bytes(512) + b"x" * 512}


def test_a_name_without_a_sync_of_its_folder_may_be_missing():
    deeds = [done(Deed.CREATE, 1, "/maps/a"), done(Deed.WRITE, 1, data=b"kept"), done(Deed.SYNC, 1)]
    assert {tuple(left(deeds, seed)) for seed in range(50)} == {(), ("/maps/a",)}


def test_a_rename_is_done_or_not():
    deeds = [*NAMED, done(Deed.RENAME, path="/maps/a", data=b"/maps/b")]
    assert {tuple(left(deeds, seed)) for seed in range(50)} == {("/maps/a",), ("/maps/b",)}


def test_nothing_is_lost_that_a_step_had_stored(tmp_path):
    if sys.platform != "linux" or shutil.which("cc") is None:
        pytest.skip("the recorder needs Linux and a C compiler")
    cuts = Cuts(tmp_path)
    assert len(cuts.promises) > 15
    assert [cuts.fault(number, seed=1) for number in range(6)] == [""] * 6
