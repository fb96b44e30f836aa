"""Runs every command of the workflows, one after the other, in a clean clone of this checkout.

The clone holds what is committed. Names of make targets pick some of the steps.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
WORKFLOWS = ROOT / ".github" / "workflows"


def main() -> None:
    """Runs the command; stops at the first step that fails."""
    wanted = [f"make {name}" for name in sys.argv[1:]]
    if unknown := [step for step in wanted if step not in steps()]:
        sys.exit(f"no workflow runs {', '.join(unknown)}; there are: {', '.join(steps())}")
    with tempfile.TemporaryDirectory(prefix="engram-clone-") as folder:
        subprocess.run(["git", "clone", "--quiet", ROOT, folder], check=True)
        for step in wanted or steps():
            started = time.monotonic()
            print(f"+ {step}", flush=True)
            ended = subprocess.run(step, shell=True, cwd=folder, check=False)
            if ended.returncode != 0:
                sys.exit(f"failed ({ended.returncode}): {step}")
            print(f"  {step}: {(time.monotonic() - started) / 60:.1f} min", flush=True)


def steps() -> list[str]:
    """The commands that the workflows run, each once: tests, wheels, documents."""
    pages = [WORKFLOWS / f"{name}.yml" for name in ("test", "release", "docs")]
    lines = [line.strip() for page in pages for line in page.read_text().splitlines()]
    return list(
        dict.fromkeys(line[len("- run: ") :] for line in lines if line.startswith("- run: "))
    )


if __name__ == "__main__":
    main()
