"""What a program prints on each instruction set that this machine can run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from engram import _core

_ORDER = ("generic", "v3", "v4")


def printed(code: str) -> set[str]:
    """The outputs of a program; its first argument is the folder that holds `tests`."""
    here = str(Path(__file__).parents[1])
    return {
        subprocess.run(
            [sys.executable, "-c", code, here],
            env={**os.environ, "ENGRAM_ISA": isa},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for isa in _ORDER[: _ORDER.index(_core.isa) + 1]
    }
