"""What a program prints on each instruction set that this machine can run.

`ENGRAM_BITS` names a folder that keeps what is printed, so that a later run of the same tests on
another machine is compared with it: `make test-arm64`.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

from engram import _core

_ORDER = ("generic", "v3", "v4")


def printed(code: str) -> set[str]:
    """The outputs of a program; its first argument is the folder that holds `tests`."""
    here = str(Path(__file__).parents[1])
    outputs = {
        subprocess.run(
            [sys.executable, "-c", code, here],
            env={**os.environ, "ENGRAM_ISA": isa},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for isa in _ORDER[: _ORDER.index(_core.isa) + 1]
    }
    return outputs | _on_another_machine(code, outputs)


def _on_another_machine(code: str, outputs: set[str]) -> set[str]:
    """What the program printed where these tests ran first; else what it printed here is kept."""
    if not (folder := os.environ.get("ENGRAM_BITS")):
        return set()
    kept = Path(folder) / hashlib.sha256(code.encode()).hexdigest()[:16]
    if not kept.exists():
        kept.write_text("".join(outputs))
    return {kept.read_text()}
