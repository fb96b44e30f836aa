"""The packages in `examples/` install, run their own tests, and are what CONTRIBUTING.md shows."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from tests.test_docs import Block, blocks, run_words

from engram import plugins
from engram.frontend import features

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"
CONTRIBUTING = ROOT / "CONTRIBUTING.md"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of packages with all examples, as pip installs them."""
    target = tmp_path_factory.mktemp("installed")
    asked = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(target))
    folders = sorted(str(one.parent) for one in EXAMPLES.glob("*/pyproject.toml"))
    subprocess.run([sys.executable, "-m", "pip", "install", *asked, *folders], check=True)
    return target


def test_the_examples_pass_their_own_tests(installed: Path) -> None:
    """As in a repository of their own: nothing of this one's configuration holds there."""
    alone = ("-c", os.devnull, "--rootdir", ".", "--noconftest", "-p", "no:cacheprovider")
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", *alone, "."],
        cwd=EXAMPLES,
        env={**os.environ, "PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr


def shown(kind: str) -> list[Block]:
    return [one for one in blocks(CONTRIBUTING) if one.kind == kind]


def test_the_code_that_is_shown_is_that_of_the_examples() -> None:
    code = "".join(one.read_text() for one in EXAMPLES.rglob("*.py"))
    settings = "".join(one.read_text() for one in EXAMPLES.rglob("pyproject.toml"))
    assert [one.text for one in shown("python") if one.text not in code] == []
    assert min(len(shown("python")), len(shown("toml"))) >= 4
    assert [one.text for one in shown("toml") if one.text not in settings] == []


def test_the_commands_that_are_shown_run(
    installed: Path, street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(installed))
    # Kinds that were loaded stay in the table; other tests must not meet those of the examples.
    monkeypatch.setattr(features, "FEATURES", dict(features.FEATURES))
    plugins._installed.cache_clear()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "street").symlink_to(street)
    try:
        for line in (line for one in shown("") for line in one.text.splitlines()):
            run_shown(shlex.split(line, comments=True))
    finally:
        plugins._installed.cache_clear()


def run_shown(words: list[str]) -> None:
    match words:
        case ["make", target]:
            assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.M), target
        case ["pre-commit", "install"]:
            assert (ROOT / ".pre-commit-config.yaml").exists()
        case ["pip", "install", "-e", folder] | ["pytest", folder]:
            assert (ROOT / folder / "pyproject.toml").exists(), folder
        case ["engram", "lab", "evaluate", "ranking", *_]:  # minutes; its policies are installed
            names = words[words.index("--policies") + 1]
            from engram.ranking.policies import policy_names

            assert {*names.split(",")} <= {*policy_names()}
        case _:
            ran = run_words(words)
            assert ran.returncode == 0, f"{shlex.join(words)}\n{ran.stderr}"
