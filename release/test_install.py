"""The wheels of `dist` in bare environments of every Python at hand, with no compiler in reach.

`make test-wheels` runs these tests. `make test` does not: wheels take minutes to build.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from tests.test_docs import DOCS, blocks, pattern_of

import engram
from release.pythons import pythons

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"
# What the documents' examples import beyond the robot's own package.
EXTRAS = "plots,view,bags,centre,agent,cluster"
MINUTES, MEGABYTES = 3.0, 430.0


@dataclass(frozen=True)
class Bare:
    """An environment of one Python whose only programs are its own."""

    version: str
    folder: Path

    def run(self, *words: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
        """Runs one of the environment's programs; a failure shows all that it printed."""
        kept = {name: value for name, value in os.environ.items() if name.startswith("PIP_")}
        env = {
            **kept,
            "PATH": str(self.folder / "bin"),
            "HOME": os.environ["HOME"],
            "CC": "/bin/false",
            "CXX": "/bin/false",
            "ENGRAM_DATA": os.environ.get("ENGRAM_DATA", ""),
        }
        command = [str(self.folder / "bin" / words[0]), *words[1:]]
        ran = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, f"{' '.join(words)}\n{ran.stdout[-6000:]}\n{ran.stderr[-6000:]}"
        return ran

    def install(self, *what: str) -> None:
        """Installs wheels; what has none for this Python is an error, never a build."""
        self.run(
            "python", "-m", "pip", "install", "--quiet", "--only-binary", ":all:",
            "--find-links", str(DIST), "-c", "constraints.txt", *what,
        )  # fmt: skip

    @property
    def installed_mb(self) -> float:
        """Of the packages, without pip and without compiled Python files."""
        (packages,) = self.folder.glob("lib/python*/site-packages")
        files = (path for path in packages.rglob("*") if path.is_file())
        counted = (path for path in files if path.suffix != ".pyc" and "/pip" not in str(path))
        return sum(path.stat().st_size for path in counted) / 1e6


@pytest.fixture(scope="module", params=list(pythons().items()), ids=lambda found: found[0])
def bare(request: pytest.FixtureRequest) -> Iterator[Bare]:
    """A new environment of each Python, empty but for pip."""
    version, interpreter = request.param
    if not list(DIST.glob(f"engram_lab-{engram.__version__}-*.whl")):
        pytest.fail(f"{DIST} holds no wheels of {engram.__version__}: run `make wheels` first")
    folder = ROOT / "build" / "release" / f"bare-{version}"
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([interpreter, "-m", "venv", folder], check=True)
    yield Bare(version, folder)
    shutil.rmtree(folder)


def test_the_first_map_page_runs_from_the_wheel_alone(
    bare: Bare, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wall_s, cpu_s = time.monotonic(), _children_cpu_s()
    bare.install(f"engram-localisation=={engram.__version__}")
    size_mb, fixed = bare.installed_mb, False
    printed = ""
    for block in blocks(DOCS / "first-map.md"):
        for words in block.commands:
            if words[1] == "plot":  # the page names this extra beside the command
                bare.install(f"engram-localisation[plots]=={engram.__version__}")
            ran = bare.run(*words, cwd=tmp_path)
            printed = ran.stdout + ran.stderr
            if words[1] == "localise" and not fixed:
                fixed = True
                minutes = (time.monotonic() - wall_s) / 60
                cpu_s = _children_cpu_s() - cpu_s
        if block.kind == "text":
            for line in block.text.strip().splitlines():
                assert pattern_of(line).search(printed), f"the page shows: {line}\n{printed}"
    assert fixed
    with capsys.disabled():
        print(
            f"\n{bare.version}: {minutes:.1f} min ({cpu_s:.0f} CPU-s) from wheel to first fix; "
            f"{size_mb:.0f} MB installed"
        )
    assert cpu_s < MINUTES * 60
    assert size_mb < MEGABYTES


def _children_cpu_s() -> float:
    """A busy machine makes minutes longer, not these."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.fixture(scope="module")
def equipped(bare: Bare) -> Bare:
    """The same environment with the laboratory, all extras and the tests' tools."""
    version = engram.__version__
    bare.install(f"engram-localisation[{EXTRAS}]=={version}", f"engram-lab=={version}")
    bare.install("pytest", "hypothesis", "pytest-xdist", "poselib")
    found = bare.run("python", "-c", "import engram, engram_lab; print(engram.__file__)")
    assert str(bare.folder) in found.stdout
    return bare


def test_every_example_of_the_documents_runs_from_the_wheels(equipped: Bare) -> None:
    _pytest(equipped, "tests/test_docs.py", "-k", "examples_of_a_page")


def test_the_goldens_are_equal_from_the_wheels(
    equipped: Bare, capsys: pytest.CaptureFixture[str]
) -> None:
    ran = equipped.run("python", "-m", "tests.goldens", "check")
    with capsys.disabled():
        print(f"\n{equipped.version}: {ran.stdout}")


@pytest.mark.long
def test_the_whole_suite_passes_on_the_wheels(
    equipped: Bare, capsys: pytest.CaptureFixture[str]
) -> None:
    said = _pytest(equipped, "-m", "not long")
    with capsys.disabled():
        print(f"\n{equipped.version}: {said}")


def _pytest(environment: Bare, *words: str) -> str:
    """Runs tests of this checkout on what is installed; pytest's last line."""
    ran = environment.run("python", "-m", "pytest", "-q", "-p", "no:cacheprovider", *words)
    return ran.stdout.strip().splitlines()[-1]
