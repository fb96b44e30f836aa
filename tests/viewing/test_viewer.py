"""`engram view` writes a recording that Rerun's own check accepts."""

from __future__ import annotations

import re
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
    assert panes_and_entities(recording) == (
        {"/map", "/live/image", "/confidence", "/inliers"},
        set(),
    )


def test_a_map_without_a_robot_has_one_pane(street: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs the extra view")
    map_drive(tmp_path / "street.engram", open_drive(street, frames="0:6:2"))
    recording = tmp_path / "street.rrd"
    words = ["view", str(tmp_path / "street.engram"), "--view", str(recording)]
    assert CliRunner().invoke(app, words).exit_code == 0
    assert panes_and_entities(recording) == ({"/map"}, set())


def panes_and_entities(recording: Path) -> tuple[set[str], set[str]]:
    """The origins of a recording's panes, and those of them under which nothing is logged."""
    printed = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", "-vvv", str(recording)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    entities = re.findall(r"entity_path: (/[\w/]*)", printed)
    # Class, name and origin of a view are neighbours in its row.
    view = r"\[(?:2D|3D|TimeSeries)\]\s*┆\s*\[[^]]+\]\s*┆\s*\[/?([^]]+)\]"
    origins = {f"/{one}" for one in re.findall(view, printed)}
    return origins, {one for one in origins if not any(name.startswith(one) for name in entities)}
