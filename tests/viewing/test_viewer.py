"""`engram view` writes a recording that Rerun's own check accepts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from engram.errors import MissingExtraError
from engram.maps import open_map
from engram.robot import RobotOptions, Settings, map_drive, open_drive, robot_on
from engram.viewing.viewer import Viewer


def test_without_rerun_the_command_that_installs_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with (
        open_map(tmp_path / "empty.engram", create=True) as opened,
        pytest.raises(MissingExtraError, match=r"engram-localisation\[view\]"),
    ):
        Viewer(opened)


def test_a_drive_becomes_a_recording(street: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs the extra view")
    path, recording = tmp_path / "street.engram", tmp_path / "street.rrd"
    map_drive(path, open_drive(street, frames="::2"))
    sequence = open_drive(street, frames="1::4")
    with (
        open_map(path) as opened,
        robot_on(opened, sequence, Settings(), RobotOptions(lanes=1, threads=False)) as robot,
    ):
        viewer = Viewer(opened, recording)
        for found in robot.drive(sequence):
            assert robot.last is not None
            viewer.see(robot.last, found)
        viewer.close()
    checked = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(recording)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.returncode == 0, checked.stderr
    assert recording.stat().st_size > 10_000
