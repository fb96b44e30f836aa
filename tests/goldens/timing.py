"""Time of two checkouts, in blocks that alternate between two processes."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path


def work(frames: int) -> int:
    """A worker: for each line of its input, one block of frames; answers with its seconds."""
    from tests.goldens import through
    from tests.goldens.cases import KITTI_06, data

    with tempfile.TemporaryDirectory(prefix="engram-timing-") as folder:
        path = Path(folder) / "there.engram"
        drive = data(KITTI_06)
        through.map_one(path, through.drive(drive), threads=True)
        robot = through.robot_over(path, through.drive(drive, there_and_back=10**6))
        for _ in range(frames):
            next(robot)
        print(through.CODE, flush=True)
        for _ in sys.stdin:
            started = time.perf_counter()
            for _ in range(frames):
                next(robot)
            print(time.perf_counter() - started, flush=True)
    return 0


def compare(other: Path, blocks: int, frames: int) -> int:
    """Prints the median ratio of this checkout's blocks to the other's."""
    here, other = Path(__file__).parents[2], other.resolve()
    if not (other / "tests" / "goldens" / "through.py").exists():
        raise SystemExit(f"{other}: has no tests/goldens by which its code could be run")
    with ExitStack() as stack:
        ours, theirs = (stack.enter_context(_worker(one, frames)) for one in (here, other))
        _expect(ours, here)
        _expect(theirs, other)
        ratios, times = [], []
        for block in range(blocks):
            pair = (ours, theirs) if block % 2 else (theirs, ours)
            took = {one: _block(one) for one in pair}
            ratios.append(took[ours] / took[theirs])
            times.append((took[ours], took[theirs]))
        for one in (ours, theirs):
            assert one.stdin is not None
            one.stdin.close()
    for name, seconds in zip((here, other), zip(*times, strict=True), strict=True):
        print(f"{name}: {statistics.median(seconds) / frames * 1e3:.3f} ms a frame")
    low, middle, high = statistics.quantiles(ratios, n=4)
    print(f"ratio {middle:.4f}, quartiles {low:.4f} to {high:.4f}, of {blocks} blocks")
    return 0


def _worker(checkout: Path, frames: int) -> subprocess.Popen[str]:
    sources = [checkout / "src", checkout / "lab" / "src"]
    return subprocess.Popen(
        [sys.executable, "-m", "tests.goldens", "worker", "--frames", str(frames)],
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, sources))},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def _expect(worker: subprocess.Popen[str], checkout: Path) -> None:
    """An installed Engram may stand before PYTHONPATH: then both would time the same code."""
    assert worker.stdout is not None
    code = worker.stdout.readline().strip()
    if not code or not Path(code).is_relative_to(checkout):
        raise SystemExit(f"{checkout}: its worker runs the code of {code or 'nothing'}")


def _block(worker: subprocess.Popen[str]) -> float:
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write("block\n")
    worker.stdin.flush()
    return float(worker.stdout.readline())
