"""Ctrl-C where nothing is half done; files that are written whole or not at all."""

import signal
from pathlib import Path

import pytest

from engram.monitor import QUIET, interruptible, write_whole


def test_a_file_gets_its_name_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    with write_whole(path) as draft:
        draft.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text("old")
    with pytest.raises(FileNotFoundError), write_whole(path):
        (tmp_path / "no folder" / "file").write_text("new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_ctrl_c_waits_for_the_next_check() -> None:
    with interruptible(QUIET) as monitor, monitor.stage("work", 3) as part:
        part.check()
        signal.raise_signal(signal.SIGINT)
        part.advance()
        with pytest.raises(KeyboardInterrupt):
            part.check()
