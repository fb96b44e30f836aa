"""A drive on disk and the program, run in this process."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import pytest

from engram.bench.data import synthetic_drive
from engram.cli import main


@dataclass
class Ran:
    """What a command did."""

    status: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


@pytest.fixture
def engram(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs `engram ARGUMENTS` and tells how it ended."""

    def run(*arguments: object) -> Ran:
        monkeypatch.setattr(sys, "argv", ["engram", *map(str, arguments)])
        capsys.readouterr()
        try:
            main()
            status = 0
        except SystemExit as exit_:
            status = int(exit_.code or 0)
        captured = capsys.readouterr()
        return Ran(status, captured.out, captured.err)

    return run


@pytest.fixture(scope="session")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve pairs of a rendered street in the plain layout."""
    folder = tmp_path_factory.mktemp("drives") / "street"
    pairs = synthetic_drive(frames=12, step_m=0.8)
    camera = pairs[0].camera
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
        for number, pair in enumerate(pairs):
            cv2.imwrite(str(folder / side / f"{number:06d}.png"), getattr(pair, side))
    stamps = "".join(f"{number / 10:.6f}\n" for number in range(len(pairs)))
    (folder / "times.txt").write_text(stamps)
    values = [
        f"{name} = {getattr(camera, name)}"
        for name in ("width", "height", "fx", "fy", "cx", "cy", "baseline_m")
    ]
    (folder / "calibration.toml").write_text("\n".join(["[rectified]", *values]) + "\n")
    return folder
