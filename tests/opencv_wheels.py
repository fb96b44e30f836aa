"""Engram beside each wheel of OpenCV: `make test-opencv`. Packages come from pip's index or cache.

All OpenCV wheels install into one folder, and the last one wins. So each is tried in both orders:
Engram installed over it, and the wheel put back over Engram's as docs/trouble.md says. In both
states the tests that read images run in that environment; `teblid` and the bench's reference must
work where the wheel on top has contrib modules. A last environment installs the extra `teblid`.
"""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
WHEELS = (
    "opencv-python",
    "opencv-python-headless",
    "opencv-contrib-python",
    "opencv-contrib-python-headless",
)
OURS = "opencv-python-headless"
TESTS = (
    "tests/frontend/test_features.py",
    "tests/frontend/test_frontend.py",
    "tests/frontend/test_opencv_contrib.py",
    "tests/geometry/test_rectification.py",
    "tests/cli/test_verbs.py::test_a_teblid_map_is_localised_in_with_teblid",
    "lab/tests/bench/test_bench.py",
)
# Whose cv2 it is, whether it opens windows, and whether it has contrib modules.
FOUND = """
import cv2, re, sys
assert cv2.__file__.startswith(sys.prefix), cv2.__file__
windows = re.search(r"GUI: +(\\w+)", cv2.getBuildInformation())[1] != "NONE"
print(windows, hasattr(getattr(cv2, "xfeatures2d", None), "TEBLID_create"))
"""


def main() -> int:
    with tempfile.TemporaryDirectory(prefix="engram-opencv-") as folder:
        built = build(Path(folder) / "wheels")
        wrong = sum(beside(wheel, built, Path(folder) / wheel) for wheel in WHEELS)
        wrong += with_the_extra(built, Path(folder) / "teblid")
    return int(wrong > 0)


def build(folder: Path) -> list[str]:
    """Wheels of both distributions, as this environment's compiler makes them."""
    folder.mkdir()
    command = ["wheel", "--no-deps", "--no-build-isolation", "-w", folder, ROOT, ROOT / "lab"]
    pip(Path(sys.executable), *command)
    return sorted(map(str, folder.glob("*.whl")))


def beside(wheel: str, built: list[str], folder: Path) -> int:
    """Number of states in which something failed."""
    python = environment(folder)
    pip(python, "install", "-c", ROOT / "constraints.txt", wheel)
    pip(python, "install", "-c", ROOT / "constraints.txt", *built)
    wrong = check(f"{wheel}, then Engram", python, top=OURS)
    # Of docs/trouble.md.
    pip(python, "install", "-c", ROOT / "constraints.txt", "--force-reinstall", "--no-deps", wheel)
    return wrong + check(f"{wheel} put back", python, top=wheel)


def with_the_extra(built: list[str], folder: Path) -> int:
    python = environment(folder)
    robot, lab = (next(one for one in built if name in one) for name in ("localisation", "lab-"))
    pip(python, "install", "-c", ROOT / "constraints.txt", robot, f"{lab}[teblid]")
    return check("engram-lab[teblid]", python, top="opencv-contrib-python-headless")


def environment(folder: Path) -> Path:
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    return folder / "bin" / "python"


def pip(python: Path, verb: str, *arguments: object) -> None:
    command = [sys.executable, "-m", "pip", "--python", python, "--quiet", verb, *arguments]
    subprocess.run([*map(str, command)], check=True)


def check(state: str, python: Path, *, top: str) -> int:
    """1 if the cv2 of an environment is not that of the wheel `top`, or a test fails or skips."""
    expected = f"{'headless' not in top} {'contrib' in top}"
    found = output(python, "-c", FOUND).strip()
    # Pytest and what else the tests need lie behind the environment's own packages.
    purelib = Path(
        output(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip()
    )
    (purelib / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    ran = output(python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *TESTS)
    (purelib / "others.pth").unlink()
    tests = ran.strip().splitlines()[-1]
    good = found == expected and "failed" not in tests and "error" not in tests
    good &= "contrib" not in top or "needs cv2.xfeatures2d" not in ran
    print(f"{'ok' if good else 'WRONG':5} {state}: windows, contrib {found}; {tests}", flush=True)
    if not good:
        print(ran, flush=True)
    return int(not good)


def output(python: Path, *arguments: str) -> str:
    ran = subprocess.run(
        [python, *arguments], cwd=ROOT, env=os.environ, capture_output=True, text=True, check=False
    )
    return ran.stdout + ran.stderr


if __name__ == "__main__":
    sys.exit(main())
