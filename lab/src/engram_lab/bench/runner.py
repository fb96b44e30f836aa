"""Runs the stages on one core and describes the machine."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from engram import _core
from engram.errors import ConfigError
from engram_lab.bench.data import BenchData, load_bench_data
from engram_lab.bench.stage import BenchReport, Machine, load_plain_pipeline, time_stage
from engram_lab.bench.stages import STAGES

Progress = Callable[[str, int, int], None]

# A quarter of a second or so for one run of either side: fewer runs tell enough.
_SLOW_STAGES = {
    "open_map_4000": 10,
    "render_pair_512": 40,
    "render_pair_512_rain": 40,
    "render_pair_512_night": 40,
    "window_ba_512": 10,
    "places_query_20000": 40,
    "places_query_1000000": 20,
    "vocabulary_train": 5,
}


def run_bench(
    only: Sequence[str] | None = None,
    repeats: int = 200,
    progress: Progress | None = None,
    data: BenchData | None = None,
) -> BenchReport:
    """Time the stages, each interleaved with its reference, on one core with warm caches.

    Args:
        only: names in `STAGES`; None runs all.
        progress: called before each stage with its name, its number from 0, and how many.
        data: the frames; None takes KITTI 06 under ``$ENGRAM_DATA``, else a synthetic drive.
    """
    names = list(STAGES) if only is None else [name for name in STAGES if name in only]
    unknown = set(only or ()) - set(STAGES)
    if unknown:
        raise ConfigError(
            f"unknown stage {', '.join(sorted(unknown))}; there are: {', '.join(STAGES)}"
        )
    if repeats < 1:
        raise ConfigError(f"repeats is {repeats}, must be at least 1")
    with _one_core() as cores:
        frames = data or load_bench_data()
        plain, note = load_plain_pipeline()
        results = []
        for number, name in enumerate(names):
            if progress:
                progress(name, number, len(names))
            prepared = STAGES[name](frames, plain)
            runs = min(repeats, _SLOW_STAGES.get(name, repeats))
            results.append(time_stage(name, prepared, runs, note or "no plain counterpart"))
    return BenchReport(_machine(frames.name, cores), tuple(results))


@contextmanager
def _one_core() -> Iterator[int]:
    """Keep this process to one core and OpenCV to one thread; undone afterwards."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    allowed = os.sched_getaffinity(0) if sys.platform == "linux" else None
    if allowed:
        os.sched_setaffinity(0, {max(allowed)})
    try:
        yield 1 if allowed else os.cpu_count() or 1
    finally:
        cv2.setNumThreads(threads)
        if allowed:
            os.sched_setaffinity(0, allowed)


def _machine(data: str, cores: int) -> Machine:
    has_poselib = importlib.util.find_spec("poselib") is not None
    return Machine(
        processor=_processor(),
        isa=_core.isa,
        cores_used=cores,
        python=platform.python_version(),
        numpy=np.__version__,
        opencv=cv2.__version__,
        poselib=importlib.metadata.version("poselib") if has_poselib else None,
        data=data,
    )


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass  # not Linux: what Python knows will do
    return platform.processor() or platform.machine()
