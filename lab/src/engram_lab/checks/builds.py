"""What a build of a fleet's map costs, against another version, in alternating runs.

    python -m engram_lab.checks.builds --against CHECKOUT --drives 16 FOLDER…

The drives are the frame logs of the folders, in order. Both versions map them in two groups and
merge these, one process at a time, so that the processor time of all processes is what the clock
would show on a machine that does nothing else; the clock itself is printed, too. CHECKOUT is built
in place, and reads the same logs.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from engram_lab.bench.against import HERE
from engram_lab.programs import Figure, command_line, report

_PROGRAM = "from engram.cli import main; main()"
_GROUPS = 2


def built_s(checkout: Path, logs: Sequence[Path]) -> tuple[float, float]:
    """Processor time and clock of one build by the code of a checkout, seconds.

    Raises:
        CalledProcessError: the build failed.
    """
    with tempfile.TemporaryDirectory(prefix="engram-build-") as folder:
        asked = [sys.executable, "-c", _PROGRAM, "build", str(Path(folder) / "fleet.engram")]
        asked += [*map(str, logs), "--workers", "1", "--groups", str(_GROUPS)]
        sources = os.pathsep.join([str(checkout / "src"), str(checkout / "lab" / "src")])
        began = time.perf_counter()
        process = subprocess.Popen(
            asked,
            cwd=checkout,
            env={**os.environ, "PYTHONPATH": sources},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise subprocess.CalledProcessError(process.returncode, asked)
        return used.ru_utime + used.ru_stime, time.perf_counter() - began


def compared(other: Path, logs: Sequence[Path], pairs: int) -> Iterator[Figure]:
    """Figures of both versions; in every second pair the other one builds first."""
    sides: dict[Path, list[tuple[float, float]]] = {HERE: [], other: []}
    for pair in range(pairs):
        for side in (HERE, other) if pair % 2 == 0 else (other, HERE):
            took = built_s(side, logs)
            sides[side].append(took)
            name = "here" if side is HERE else "there"
            yield Figure(f"pair {pair + 1}, {name}, processor", took[0], "s")
            yield Figure(f"pair {pair + 1}, {name}, clock", took[1], "s")
    for at, name in enumerate(("processor", "clock")):
        ratios = [a[at] / b[at] for a, b in zip(sides[HERE], sides[other], strict=True)]
        yield Figure(f"ratio, {name}, median", statistics.median(ratios))


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("folders", nargs="+", type=Path, help="of frame logs")
    parser.add_argument("--against", type=Path, required=True, metavar="CHECKOUT")
    parser.add_argument("--drives", type=int, default=16)
    parser.add_argument("--pairs", type=int, default=2)
    given = parser.parse_args()
    logs = [log for one in given.folders for log in sorted(one.glob("*.framelog"))][: given.drives]
    if len(logs) < given.drives:
        parser.error(f"the folders hold {len(logs)} logs, {given.drives} were requested")
    report(compared(given.against.resolve(), logs, given.pairs), given.json, "builds")


if __name__ == "__main__":
    main()
