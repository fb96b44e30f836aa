"""`engram view` writes a recording that Rerun's own check accepts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from engram.cli.app import app
from engram.errors import InputError, MissingExtraError
from engram.robot.mapping import map_drive
from engram.sequences.opening import open_drive
from engram.viewing.viewer import Viewer, viewer_for


def test_without_rerun_the_command_that_installs_it_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"engram-localisation\[view\]"):
        Viewer()


def test_what_is_neither_window_nor_recording_is_refused() -> None:
    with pytest.raises(InputError, match=r"NAME\.rrd"):
        viewer_for(Path("street.png"))


@pytest.mark.parametrize("verb", ["map", "localise", "live"])
def test_a_drive_becomes_a_recording(verb: str, street: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs the extra view")
    path, recording = tmp_path / "street.engram", tmp_path / "street.rrd"
    if verb != "map":
        map_drive(path, open_drive(street, frames="0:6:2"))
    given = ["--play", str(street)] if verb == "live" else [str(street), "--frames", "1::6"]
    ran = CliRunner().invoke(app, [verb, str(path), *given, "--view", str(recording)])
    assert ran.exit_code == 0, ran.output
    checked = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(recording)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.returncode == 0, checked.stderr
    assert recording.stat().st_size > 10_000
