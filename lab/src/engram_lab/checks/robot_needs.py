"""What a robot needs: processor time of a step, on each instruction set, and memory.

    python -m engram_lab.checks.robot_needs
    python -m engram_lab.checks.robot_needs --one 512 --doctor

Every third frame of KITTI 06 is mapped. Six robots with default settings, each lost at first, then
drive the clip in that map, at KITTI's size and at 512×384. Processor time is that of all threads of
the process, which a busy machine changes little: H frames a second take H times the mean. The
doctor is off unless asked for: it looks at the first frames of a drive only, here at all of them.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from engram import _core
from engram.cli.settings import read_settings
from engram.frontend.frame import BRIEF, StereoPair
from engram.maps.map import open_map
from engram_lab.bench.data import load_bench_data
from engram_lab.programs import Figure, command_line, report

SIZES = ("512", "full")
# What ships, the default first.
KINDS = (BRIEF, "net")
_INSTRUCTION_SETS = ("generic", "v3", "v4")
_PERIOD_NS = 100_000_000
_MAPPED = 3  # every so many frames are the map
_ROBOTS = 6


def measured(
    pairs: Sequence[StereoPair], *, doctor: bool = False, features: str = BRIEF
) -> Iterator[Figure]:
    """Localised share, processor time a step in ms, and the process's largest memory in MB."""
    settings = read_settings(None, [f"frontend.descriptor={features}"]).of_robot()
    with tempfile.TemporaryDirectory(prefix="engram-needs-") as folder:
        path = Path(folder) / "street.engram"
        with (
            open_map(path, create=True) as opened,
            opened.robot(pairs[0].camera, settings, name="needs", maps=True) as mapper,
        ):
            for number in range(0, len(pairs), _MAPPED):
                mapper.step(_at(number, pairs[number]))
        taken = []
        localised = 0
        if not doctor:
            settings = replace(settings, doctor=replace(settings.doctor, frames=0))
        with open_map(path) as opened:
            for _ in range(_ROBOTS):
                with opened.robot(pairs[0].camera, settings) as robot:
                    for number, pair in enumerate(pairs):
                        stamped = _at(number, pair)
                        begun = time.process_time()
                        localised += robot.step(stamped).localised
                        taken.append(1e3 * (time.process_time() - begun))
    yield Figure("localised", 100 * localised / len(taken), "%")
    yield Figure("processor time of a step, median", float(np.median(taken)), "ms")
    yield Figure("processor time of a step, mean", float(np.mean(taken)), "ms")
    yield Figure("processor time of a step, 99 %", float(np.percentile(taken, 99)), "ms")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield Figure("memory of the process, at most, with the clip in it", peak / 1024, "MB")


def _at(number: int, pair: StereoPair) -> StereoPair:
    return replace(pair, stamp_ns=(number + 1) * _PERIOD_NS)


def main() -> None:
    """Measures each instruction set in a process of its own."""
    parser = command_line(__doc__)
    parser.add_argument("--one", choices=SIZES, help="measure this size in this process alone")
    parser.add_argument("--doctor", action="store_true", help="with --one: leave the doctor on")
    parser.add_argument("--features", default=BRIEF, choices=KINDS, help="with --one: the kind")
    asked = parser.parse_args()
    if asked.one:
        pairs = load_bench_data().at(asked.one)
        figures = measured(pairs, doctor=asked.doctor, features=asked.features)
        report(figures, asked.json, title=asked.one)
        return
    sets = _INSTRUCTION_SETS if _core.isa in _INSTRUCTION_SETS else (_core.isa,)
    for isa in sets[: sets.index(_core.isa) + 1]:
        for features in KINDS:
            for size in SIZES:
                title = f"{isa}, {size}" + (f", {features}" if features != BRIEF else "")
                report(_elsewhere(isa, size, features), asked.json, title)


def _elsewhere(isa: str, size: str, features: str) -> list[Figure]:
    with tempfile.TemporaryDirectory(prefix="engram-needs-") as folder:
        file = Path(folder) / "figures.json"
        subprocess.run(
            [
                *(sys.executable, "-m", __spec__.name, "--one", size),
                *("--features", features, "--json", str(file)),
            ],
            env={**os.environ, "ENGRAM_ISA": isa},
            stdout=subprocess.DEVNULL,
            check=True,
        )
        (figures,) = json.loads(file.read_text(encoding="utf-8")).values()
    return [Figure(**figure) for figure in figures]


if __name__ == "__main__":
    main()
