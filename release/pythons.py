"""The CPythons of this machine that Engram supports."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

SUPPORTED = ("3.11", "3.12", "3.13", "3.14")
# The first Python whose stable ABI serves nanobind; one wheel serves it and all later ones.
STABLE_ABI_SINCE = "3.12"


def pythons() -> dict[str, Path]:
    """Version → interpreter, oldest first: those on the path, and pyenv's."""
    found = {version: _interpreter(version) for version in SUPPORTED}
    return {version: path for version, path in found.items() if path is not None}


def _interpreter(version: str) -> Path | None:
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    folders = [Path(one) for one in os.environ["PATH"].split(os.pathsep)]
    folders += sorted(pyenv.glob(f"{version}.*/bin"), reverse=True)
    candidates = (folder / f"python{version}" for folder in folders)
    return next((one for one in candidates if one.exists() and _is_cpython(one, version)), None)


def _is_cpython(interpreter: Path, version: str) -> bool:
    """Whether it runs: pyenv's shims exist for versions that are not switched on."""
    code = "import sys; print(sys.implementation.name, '%d.%d' % sys.version_info[:2])"
    ran = subprocess.run([interpreter, "-c", code], capture_output=True, text=True, check=False)
    return ran.stdout.split() == ["cpython", version]
