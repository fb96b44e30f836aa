"""Drafts of new files, whole under their name or gone; and the locks of those who write."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from engram.errors import InputError, MapError
from engram.files import WriterLock, current_holder, draft_folder, remove_left_drafts
from engram.maps.map import Map

_WRITES_ON = """
import sys
from pathlib import Path
from engram.files import draft_folder
with draft_folder(Path(sys.argv[1])) as folder:
    (folder / "half").write_bytes(b"half a map")
    print(folder, flush=True)
    sys.stdin.read()
"""


class Writer:
    """Another process that has begun a draft."""

    def __init__(self, path: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _WRITES_ON, str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        self.folder = Path(self._process.stdout.readline().strip())

    def kill(self) -> None:
        self._process.send_signal(signal.SIGKILL)
        self._process.communicate()

    def finish(self) -> int:
        self._process.communicate("")
        return self._process.returncode


def test_the_next_draft_for_a_name_removes_what_a_killed_process_left(tmp_path: Path) -> None:
    path = tmp_path / "town.engram"
    writer = Writer(path)
    writer.kill()
    assert (writer.folder / "half").exists()
    Map.create(path).close()
    assert not writer.folder.exists()
    assert not [left for left in tmp_path.iterdir() if left.suffix == ".draft"]


def test_a_draft_that_is_being_written_stays(tmp_path: Path) -> None:
    path = tmp_path / "town.engram"
    writer = Writer(path)
    Map.create(path).close()
    assert (writer.folder / "half").exists()
    assert writer.finish() == 0
    assert not writer.folder.exists()


def test_drafts_of_other_names_stay(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "town[1].engram")
    writer.kill()
    Map.create(tmp_path / "town1.engram").close()
    assert writer.folder.exists()
    Map.create(tmp_path / "town[1].engram").close()
    assert not writer.folder.exists()


def test_a_killed_run_s_drafts_go_by_pattern(tmp_path: Path) -> None:
    left, held = Writer(tmp_path / "order-0-1.engram"), Writer(tmp_path / "order-1.engram")
    left.kill()
    remove_left_drafts(tmp_path, "order-*")
    assert not left.folder.exists()
    assert held.folder.exists()
    assert held.finish() == 0


def test_a_draft_killed_before_it_was_locked_is_removed(tmp_path: Path) -> None:
    (left := tmp_path / ".town.engram.abc.draft").mkdir()
    with draft_folder(tmp_path / "town.engram"):
        assert not left.exists()


def test_what_is_no_draft_s_folder_stays(tmp_path: Path) -> None:
    (file := tmp_path / ".town.engram.abc.draft").write_text("mine")
    with draft_folder(tmp_path / "town.engram"):
        assert file.read_text() == "mine"


def test_a_mistyped_folder_is_not_made(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match="is not a folder"),
        draft_folder(tmp_path / "twon" / "map.engram"),
    ):
        pass
    assert not (tmp_path / "twon").exists()


def test_no_lock_is_taken_through_a_symbolic_link(tmp_path: Path) -> None:
    """Whoever may write to the folder could have the file of another overwritten."""
    (other := tmp_path / "precious").write_text("mine")
    lock = tmp_path / "town.engram-lock"
    for target in (other, tmp_path / "not-there"):
        lock.symlink_to(target)
        with pytest.raises(MapError, match="is a symbolic link"):
            WriterLock(tmp_path / "town.engram")
        assert current_holder(tmp_path / "town.engram") is None
        lock.unlink()
    assert other.read_text() == "mine"
    assert not (tmp_path / "not-there").exists()


def test_what_is_no_regular_file_is_no_lock(tmp_path: Path) -> None:
    lock = tmp_path / "town.engram-lock"
    for make, remove in ((os.mkfifo, os.unlink), (os.mkdir, os.rmdir)):
        make(lock)
        with pytest.raises(MapError, match="engram-lock"):
            WriterLock(tmp_path / "town.engram")
        assert current_holder(tmp_path / "town.engram") is None
        remove(lock)
    held = WriterLock(tmp_path / "town.engram")
    assert current_holder(tmp_path / "town.engram") == held.holder
    held.release()
    assert current_holder(tmp_path / "town.engram") is None
