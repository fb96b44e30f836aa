"""A drive on disk and the program, run in this process."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import Any

import pytest
from tests.cli.json_schemas import problems_of_line

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
        ran = Ran(status, captured.out, captured.err)
        if "--json" in sys.argv and ran.out:
            assert problems_of_line(sys.argv[1:], ran.out) == []
        return ran

    return run
