"""Plants faults, one at a time, in a copy of the sources, and asks whether a test notices.

python -m engram_lab.checks.planted_faults            # in the root of the project
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

_TESTS = "lab/tests/test_planted_faults.py"
_COPIED = ("src", "lab", "tests", "pyproject.toml", "conftest.py")


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes:
        file: in which it is planted.
        right, wrong: the text there, and what stands in its place.
        test: the test that must fail.
    """

    file: str
    right: str
    wrong: str
    test: str


FAULTS = {
    "the level of path-near is 0.3": Fault(
        "src/engram/graph/basin.py",
        "BASIN_LEVEL = 0.6",
        "BASIN_LEVEL = 0.3",
        "test_path_near_ranks_by_paths_only_where_six_in_ten_would_match",
    ),
    "maps are compared to 10 m only": Fault(
        "src/engram/fleet/merge/gate.py",
        "np.arange(0.0, 20.5, 0.5)",
        "np.arange(0.0, 10.5, 0.5)",
        "test_maps_are_compared_up_to_twenty_metres",
    ),
    "parallel time is a mean": Fault(
        "src/engram/fleet/build/building.py",
        "max((one.seconds for one in self.mapped), default=0.0)",
        "sum(one.seconds for one in self.mapped) / max(len(self.mapped), 1)",
        "test_parallel_time_is_that_of_the_slowest_group",
    ),
    "a mission's hour is of the wrong drive": Fault(
        "lab/src/engram_lab/trial.py",
        "            session = session_of_drive(sequence)\n",
        "            session = session_of_drive(opened[0])\n",
        "test_a_missions_hour_is_that_of_its_own_drive",
    ),
    "nodes are counted from the first merge": Fault(
        "lab/src/engram_lab/studies/fleet/results.py",
        "return self.merges[-1].nodes if self.merges",
        "return self.merges[0].nodes if self.merges",
        "test_nodes_of_a_parallel_build_are_those_after_the_last_merge",
    ),
    "own nodes are left out of united": Fault(
        "lab/src/engram_lab/studies/fleet/steps.py",
        "return mine + sum(",
        "return sum(",
        "test_united_counts_own_nodes_and_what_was_sent_once",
    ),
}


def planted(text: str, fault: Fault) -> str:
    """The text of a file with the fault in it."""
    return text.replace(fault.right, fault.wrong)


def noticed(root: Path, fault: Fault) -> bool:
    """Whether the fault's test fails in a copy of the sources that has it, and only there."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in _COPIED:
            source = root / name
            if source.is_dir():
                shutil.copytree(source, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source, copy / name)
        before = _passes(copy, fault.test)
        place = copy / fault.file
        place.write_text(planted(place.read_text(encoding="utf-8"), fault), encoding="utf-8")
        return before and not _passes(copy, fault.test)


def _passes(copy: Path, test: str) -> bool:
    paths = os.pathsep.join(str(copy / name) for name in ("src", "lab/src", "."))
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", f"{_TESTS}::{test}", "-q", "-p", "no:cacheprovider"],
        cwd=copy,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        check=False,
    )
    return ran.returncode == 0


def main() -> None:
    """Plants every fault; exit status 1 if one is not noticed."""
    missed = 0
    for name, fault in FAULTS.items():
        found = noticed(Path.cwd(), fault)
        missed += not found
        print(f"{'noticed' if found else 'MISSED '}  {name}", flush=True)
    sys.exit(missed > 0)


if __name__ == "__main__":
    main()
