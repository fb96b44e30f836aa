"""Stages of this checkout against those of another one, in alternating blocks.

Each side is a process of its own on the same core. Alternating call by call, the second side would
find warm data and look 15 % too fast.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from engram.errors import ConfigError
from engram_lab.bench import blocks as worker

HERE = Path(__file__).parents[4]


@dataclass(frozen=True, slots=True)
class Comparison:
    """One stage of both sides."""

    name: str
    ours_ms: float
    theirs_ms: float
    ratio: float
    low: float
    high: float


def compare(
    other: Path, stages: Sequence[str], blocks: int = 12, runs: int = 60
) -> Iterator[Comparison]:
    """Time stages of this checkout and of another one, both built in place."""
    with ExitStack() as stack:
        sides = [stack.enter_context(_side(root)) for root in (HERE, other.resolve())]
        for side, root in zip(sides, (HERE, other.resolve()), strict=True):
            code = _read(side)
            if not code or not Path(code).is_relative_to(root):
                raise ConfigError(f"{root}: runs the code of {code or 'nothing'}; build it there")
        for name in stages:
            for side in sides:
                _block(side, name, runs)  # warm
            times = [
                [_block(sides[at], name, runs) for at in order][:: 1 if order[0] == 0 else -1]
                for order in ([0, 1], [1, 0]) * (blocks // 2)
            ]
            ours, theirs = ([1e3 * pair[at] / runs for pair in times] for at in (0, 1))
            low, ratio, high = statistics.quantiles([a / b for a, b in times], n=4)
            middle = statistics.median
            yield Comparison(name, middle(ours), middle(theirs), ratio, low, high)
        for side in sides:
            assert side.stdin is not None
            side.stdin.close()


def _side(root: Path) -> subprocess.Popen[str]:
    sources = [root / "src", root / "lab" / "src"]
    return subprocess.Popen(
        [sys.executable, worker.__file__],
        cwd=root,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, sources))},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def _read(side: subprocess.Popen[str]) -> str:
    assert side.stdout is not None
    return side.stdout.readline().strip()


def _block(side: subprocess.Popen[str], name: str, runs: int) -> float:
    assert side.stdin is not None
    side.stdin.write(f"{name} {runs}\n")
    side.stdin.flush()
    answer = _read(side)
    if not answer:
        raise ConfigError(f"stage {name}: a side ended; does its checkout have this stage?")
    return float(answer)
