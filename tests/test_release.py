"""One version, one list of Pythons, and workflows whose commands run anywhere."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml
from release import steps
from release.pythons import SUPPORTED

import engram

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PROJECTS = [
    tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    for folder in (ROOT, ROOT / "lab")
]


def test_the_version_is_the_same_everywhere() -> None:
    core, lab = PROJECTS
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    (latest, *_) = re.findall(r"^## (\S+?),? ", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert {core["version"], lab["version"], cited["version"], latest} == {engram.__version__}
    assert f"engram-localisation=={engram.__version__}" in lab["dependencies"]


def test_both_distributions_and_the_workflow_name_the_same_pythons() -> None:
    for project in PROJECTS:
        named = [
            one.rpartition(" ")[2] for one in project["classifiers"] if ":: Python :: 3." in one
        ]
        assert named == list(SUPPORTED)
    jobs = yaml.safe_load((ROOT / ".github/workflows/test.yml").read_text())["jobs"]
    assert jobs["test"]["strategy"]["matrix"]["python"] == list(SUPPORTED)


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_every_command_of_a_workflow_is_a_target_of_make(workflow: Path) -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
    jobs = yaml.safe_load(workflow.read_text())["jobs"]
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert commands
    for command in commands:
        assert re.fullmatch(r"make [\w-]+", command), command
        assert command.removeprefix("make ") in targets, command
        assert command in steps.steps()


def test_the_citation_names_both_papers() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert [(one["authors"][0]["family-names"], one["year"]) for one in cited["references"]] == [
        ("Linegar", 2015),
        ("Gadd", 2016),
    ]


def test_the_laboratorys_source_distribution_takes_along_what_it_includes() -> None:
    def included(file: Path) -> set[Path]:
        """Of the core's headers, those that a file needs."""
        names = re.findall(r'#include "([^"]+)"', file.read_text())
        found = {core / name for name in names if (core / name).is_file()}
        return found.union(*(included(one) for one in found))

    core = ROOT / "src" / "core"
    settings = tomllib.loads((ROOT / "lab" / "pyproject.toml").read_text())["tool"]["scikit-build"]
    carried = {
        (ROOT / "lab" / source).resolve(): target
        for source, target in settings["sdist"]["force-include"].items()
    }
    sources = [core / "dispatch.cpp", *(ROOT / "lab" / "core").rglob("*.?pp")]
    needed = set[Path]().union(*map(included, sources))
    assert needed | {core / "dispatch.cpp", ROOT / "cmake/EngramKernels.cmake"} == set(carried)
    for source, target in carried.items():
        assert target == f"shared/{source.relative_to(ROOT)}"
